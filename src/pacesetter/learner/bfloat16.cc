// Matrix products of bfloat16 operands, summed in float32, by oneDNN, for XLA to call.
//
// A product is made in parts: a matrix of a stack each, or the two halves of one matrix's rows.
// XLA's threads take them one by one; within a part oneDNN uses one thread.

#include <omp.h>

#include <atomic>
#include <compare>
#include <map>
#include <memory>

#include "oneapi/dnnl/dnnl.hpp"
#include "xla/ffi/api/ffi.h"

namespace {

namespace ffi = xla::ffi;
using dnnl::memory;

constexpr double kShared = 4e6;  // operations from which several threads are quicker than one

const dnnl::engine& Engine() {
  static const dnnl::engine engine(dnnl::engine::kind::cpu, 0);
  return engine;
}

memory::desc Matrix(int64_t rows, int64_t columns, bool turned, int64_t step,
                    memory::data_type type) {
  return memory::desc({rows, columns}, type, {turned ? 1 : step, turned ? step : 1});
}

// out (m, n) = left (m, k) right (k, n), row by row. `left_t` has the left side stored as
// (k, left_step), of which m columns count; `right_t` the right one as (n, k).
struct Sizes {
  int64_t m, n, k, left_step;
  bool left_t, right_t;
  auto operator<=>(const Sizes&) const = default;

  dnnl::matmul::primitive_desc plan() const {
    return {Engine(), Matrix(m, k, left_t, left_step, memory::data_type::bf16),
            Matrix(k, n, right_t, right_t ? k : n, memory::data_type::bf16),
            Matrix(m, n, false, n, memory::data_type::f32)};
  }
};

// What oneDNN has compiled for some sizes, and where one thread's operands are.
struct Compiled {
  explicit Compiled(const dnnl::matmul::primitive_desc& plan)
      : call(plan),
        left(plan.src_desc(), Engine(), nullptr),
        right(plan.weights_desc(), Engine(), nullptr),
        out(plan.dst_desc(), Engine(), nullptr) {}
  dnnl::matmul call;
  memory left, right, out;
};

// One call: its operands, and the parts that are left.
struct Work {
  Sizes sizes;  // of a part
  const uint16_t *left, *right;
  float* out;
  int64_t left_part, right_part;  // from one part to the next
  int total;
  ffi::CountDownPromise made;
  std::atomic<int> next{0};

  void part(int index) {
    thread_local const bool alone = (omp_set_num_threads(1), true);
    thread_local dnnl::stream stream(Engine());
    thread_local std::map<Sizes, Compiled> compiled;
    auto found = compiled.find(sizes);
    if (found == compiled.end()) found = compiled.emplace(sizes, Compiled(sizes.plan())).first;
    auto& [call, left_side, right_side, result] = found->second;
    left_side.set_data_handle(const_cast<uint16_t*>(left + index * left_part));
    right_side.set_data_handle(const_cast<uint16_t*>(right + index * right_part));
    result.set_data_handle(out + index * sizes.m * sizes.n);
    call.execute(stream, {{DNNL_ARG_SRC, left_side},
                          {DNNL_ARG_WEIGHTS, right_side},
                          {DNNL_ARG_DST, result}});
    stream.wait();
  }

  void drain() {
    for (int index; (index = next.fetch_add(1)) < total;) {
      part(index);
      made.CountDown();
    }
  }
};

ffi::Future Product(ffi::ThreadPool pool, bool left_t, bool right_t, ffi::Buffer<ffi::BF16> left,
                    ffi::Buffer<ffi::BF16> right, ffi::ResultBuffer<ffi::F32> out) {
  const auto shape = out->dimensions();
  const int64_t m = shape[shape.size() - 2], n = shape.back();
  const int64_t pair = out->element_count() / m / n, k = left.element_count() / pair / m;
  const bool shared = 2.0 * pair * m * n * k >= kShared && pool.num_threads() > 1;
  const int halves = shared && pair == 1 && m % 2 == 0 ? 2 : 1;
  auto work = std::make_shared<Work>();
  work->sizes = {m / halves, n, k, left_t ? m : k, left_t, right_t};
  work->left = static_cast<const uint16_t*>(left.untyped_data());
  work->right = static_cast<const uint16_t*>(right.untyped_data());
  work->out = out->typed_data();
  work->left_part = halves == 1 ? m * k : left_t ? m / 2 : m / 2 * k;
  work->right_part = halves == 1 ? k * n : 0;
  work->total = pair * halves;
  work->made = ffi::CountDownPromise(work->total);
  ffi::Future future(work->made);
  if (shared) {
    const int helpers = std::min<int>(pool.num_threads(), work->total) - 1;
    for (int i = 0; i < helpers; i++) pool.Schedule([work] { work->drain(); });
  }
  // Nothing waits for helpers, who may come late or never: this thread makes all parts that none
  // has taken, and XLA goes on once the last is made.
  work->drain();
  return future;
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(product, Product,
                              ffi::Ffi::Bind()
                                  .Ctx<ffi::ThreadPool>()
                                  .Attr<bool>("left_t")
                                  .Attr<bool>("right_t")
                                  .Arg<ffi::Buffer<ffi::BF16>>()
                                  .Arg<ffi::Buffer<ffi::BF16>>()
                                  .Ret<ffi::Buffer<ffi::F32>>());

// Whether oneDNN makes a product on this processor in bfloat16 proper; without instructions for it
// XLA is as quick. Asked before XLA is told to call the above.
extern "C" bool fits(int m, int n, int k, bool left_t, bool right_t) {
  if (dnnl::get_effective_cpu_isa() < dnnl::cpu_isa::avx512_core_bf16) return false;
  try {
    return bool(Sizes{m, n, k, left_t ? m : k, left_t, right_t}.plan());
  } catch (const dnnl::error&) {
    return false;
  }
}
