// Float32 matrix products by libxsmm, for XLA to call.
//
// A part of a product is a block of columns.

#include <libxsmm.h>

#include <algorithm>
#include <vector>

#include "parts.h"

namespace {

constexpr int kWidth = 64;  // columns of a block

struct alignas(64) Line {
  float numbers[16];
};

// out (pair, m, n) = left (pair, m, k) right (pair, k, n), row by row. `left_t` has the left side
// stored as (pair, k, m), `right_t` the right one as (pair, n, k).
struct Sizes {
  int m, n, k;
  bool left_t, right_t;

  // What makes a block of so many columns; null if there is none. libxsmm counts by columns, so
  // the two sides change places.
  libxsmm_smmfunction kernel(int width) const {
    if (width == 0 || width > n) return nullptr;
    const int right = right_t ? width : n, left = left_t ? m : k;
    const int flags = left_t ? LIBXSMM_GEMM_FLAG_TRANS_B : LIBXSMM_GEMM_FLAG_NONE;
    const int prefetch = LIBXSMM_GEMM_PREFETCH_NONE;
    const float one = 1, zero = 0;
    return libxsmm_smmdispatch(width, m, k, &right, &left, &n, &one, &zero, &flags, &prefetch);
  }
};

// One call: its operands, and how many blocks each network has.
struct Work {
  Sizes sizes;
  const float* left;
  const float* right;
  float* out;
  int blocks;
  libxsmm_smmfunction whole, rest;

  void block(int index) const {
    const auto& [m, n, k, left_t, right_t] = sizes;
    const size_t network = index / blocks;
    const size_t at = static_cast<size_t>(index % blocks) * kWidth;
    const int width = std::min<int>(kWidth, n - static_cast<int>(at));
    const float* from = right + network * k * n;
    if (right_t) {
      thread_local std::vector<Line> turned;
      turned.resize(std::max<size_t>(turned.size(), static_cast<size_t>(k) * kWidth / 16));
      libxsmm_otrans(turned.data(), from + at * k, sizeof(float), k, width, k, width);
      from = turned.data()->numbers;
    } else {
      from += at;
    }
    const auto call = width == kWidth ? whole : rest;
    call(from, left + network * m * k, out + network * m * n + at);
  }
};

ffi::Future Product(ffi::ThreadPool pool, bool left_t, bool right_t, ffi::Buffer<ffi::F32> left,
                    ffi::Buffer<ffi::F32> right, ffi::ResultBuffer<ffi::F32> out) {
  const auto shape = out->dimensions();
  const int m = shape[shape.size() - 2], n = shape.back(), pair = out->element_count() / m / n;
  const int k = left.element_count() / pair / m;
  const Sizes sizes{m, n, k, left_t, right_t};
  const Work work{sizes, left.typed_data(), right.typed_data(), out->typed_data(),
                  (n + kWidth - 1) / kWidth, sizes.kernel(kWidth), sizes.kernel(n % kWidth)};
  const bool shared = 2.0 * pair * m * n * k >= kShared;
  return MakeAll(pool, shared, pair * work.blocks, [work](int index) { work.block(index); });
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(product, Product, Signature<ffi::F32>());

// Whether libxsmm makes a product on this processor; asked before XLA is told to call the above.
extern "C" bool fits(int m, int n, int k, bool left_t, bool right_t) {
  const Sizes sizes{m, n, k, left_t, right_t};
  return (n < kWidth || sizes.kernel(kWidth)) && (n % kWidth == 0 || sizes.kernel(n % kWidth));
}
