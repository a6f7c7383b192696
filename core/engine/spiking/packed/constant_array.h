// Defines an array of weights that never changes once it is built, in memory of its own or in
// memory that processes share.
#pragma once

#include <cstddef>
#include <memory>
#include <utility>

#include "core/engine/spiking/packed/aligned_vector.h"

namespace spikeserve {

// Starts on a cache line. Copies refer to the same memory. Const members are thread-safe.
template <class T>
class ConstantArray {
 public:
  ConstantArray() = default;
  // NOLINTNEXTLINE(google-explicit-constructor): a finished vector becomes the array of a struct.
  ConstantArray(AlignedVector<T> values) : size_(values.size()) {
    const auto owner = std::make_shared<const AlignedVector<T>>(std::move(values));
    data_ = std::shared_ptr<const T>(owner, owner->data());
  }

  const T* data() const { return data_.get(); }
  size_t bytes() const { return size_ * sizeof(T); }

  // Continues with a copy of the same content. `data` keeps the memory alive.
  void MoveTo(std::shared_ptr<const T> data) { data_ = std::move(data); }

 private:
  std::shared_ptr<const T> data_;
  size_t size_ = 0;
};

}  // namespace spikeserve
