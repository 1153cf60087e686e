// Matrix products of bfloat16 operands, summed in float32, by oneDNN, for XLA to call.
//
// A part of a product is a matrix of a stack, or half of a single matrix's rows. Within it oneDNN
// uses one thread.

#include <omp.h>

#include <compare>
#include <map>

#include "oneapi/dnnl/dnnl.hpp"
#include "parts.h"

namespace {

using dnnl::memory;

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

// One thread's part of a product.
void Make(const Sizes& sizes, const uint16_t* left, const uint16_t* right, float* out) {
  thread_local const bool alone = (omp_set_num_threads(1), true);
  thread_local dnnl::stream stream(Engine());
  thread_local std::map<Sizes, Compiled> compiled;
  auto found = compiled.find(sizes);
  if (found == compiled.end()) found = compiled.emplace(sizes, Compiled(sizes.plan())).first;
  auto& [call, left_side, right_side, result] = found->second;
  left_side.set_data_handle(const_cast<uint16_t*>(left));
  right_side.set_data_handle(const_cast<uint16_t*>(right));
  result.set_data_handle(out);
  call.execute(stream, {{DNNL_ARG_SRC, left_side},
                        {DNNL_ARG_WEIGHTS, right_side},
                        {DNNL_ARG_DST, result}});
  stream.wait();
}

ffi::Future Product(ffi::ThreadPool pool, bool left_t, bool right_t, ffi::Buffer<ffi::BF16> left,
                    ffi::Buffer<ffi::BF16> right, ffi::ResultBuffer<ffi::F32> out) {
  const auto shape = out->dimensions();
  const int64_t m = shape[shape.size() - 2], n = shape.back();
  const int64_t pair = out->element_count() / m / n, k = left.element_count() / pair / m;
  const bool shared = 2.0 * pair * m * n * k >= kShared && pool.num_threads() > 1;
  const int halves = shared && pair == 1 && m % 2 == 0 ? 2 : 1;
  const Sizes part{m / halves, n, k, left_t ? m : k, left_t, right_t};
  const int64_t left_part = halves == 1 ? m * k : left_t ? m / 2 : m / 2 * k;
  const int64_t right_part = halves == 1 ? k * n : 0, out_part = part.m * n;
  const auto* from = static_cast<const uint16_t*>(left.untyped_data());
  const auto* by = static_cast<const uint16_t*>(right.untyped_data());
  float* to = out->typed_data();
  return MakeAll(pool, shared, pair * halves, [=](int i) {
    Make(part, from + i * left_part, by + i * right_part, to + i * out_part);
  });
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(product, Product, Signature<ffi::BF16>());

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
