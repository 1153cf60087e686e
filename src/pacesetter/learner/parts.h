// A product made in parts, which XLA's threads take one by one. What each part makes depends on no
// thread, so results are the same for any number of them.

#pragma once

#include <algorithm>
#include <atomic>
#include <functional>
#include <memory>

#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;

constexpr double kShared = 4e6;  // operations from which several threads are quicker than one

// How XLA calls a product of operands of a type.
template <ffi::DataType Operands>
constexpr auto Signature() {
  return ffi::Ffi::Bind()
      .Ctx<ffi::ThreadPool>()
      .Attr<bool>("left_t")
      .Attr<bool>("right_t")
      .Arg<ffi::Buffer<Operands>>()
      .template Arg<ffi::Buffer<Operands>>()
      .template Ret<ffi::Buffer<ffi::F32>>();
}

// One call, and the parts that are left.
struct Parts {
  std::function<void(int)> make;
  int total;
  ffi::CountDownPromise made{total};
  std::atomic<int> next{0};

  void drain() {
    for (int index; (index = next.fetch_add(1)) < total;) {
      make(index);
      made.CountDown();
    }
  }
};

// Make all parts, on other threads too if `shared`.
inline ffi::Future MakeAll(ffi::ThreadPool pool, bool shared, int total,
                           std::function<void(int)> make) {
  auto parts = std::make_shared<Parts>(std::move(make), total);
  ffi::Future future(parts->made);
  if (shared) {
    const int helpers = std::min<int>(pool.num_threads(), total) - 1;
    for (int i = 0; i < helpers; i++) pool.Schedule([parts] { parts->drain(); });
  }
  // Nothing waits for helpers, who may come late or never: this thread makes all parts that none
  // has taken, and XLA goes on once the last is made.
  parts->drain();
  return future;
}
