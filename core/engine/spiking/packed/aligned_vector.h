// Defines a vector that starts on a cache line. If the length of a row is a multiple of a cache
// line, no SIMD load of the row crosses a line boundary.
#pragma once

#include <algorithm>
#include <cstddef>
#include <new>
#include <vector>

namespace spikeserve {

inline constexpr std::align_val_t kCacheLine{64};

template <class T>
struct CacheLineAllocator {
  using value_type = T;

  CacheLineAllocator() = default;
  template <class U>
  // NOLINTNEXTLINE(google-explicit-constructor): containers convert allocators implicitly.
  CacheLineAllocator(const CacheLineAllocator<U>&) {}

  T* allocate(size_t count) {
    return static_cast<T*>(::operator new(count * sizeof(T), kCacheLine));
  }
  void deallocate(T* memory, size_t) { ::operator delete(memory, kCacheLine); }

  friend bool operator==(const CacheLineAllocator&, const CacheLineAllocator&) { return true; }
};

template <class T>
using AlignedVector = std::vector<T, CacheLineAllocator<T>>;

// As vector->assign(size, 0), which the library compiles to a loop over the elements.
template <class Vector>
void AssignZeros(Vector* vector, size_t size) {
  vector->resize(size);
  std::fill_n(vector->data(), size, typename Vector::value_type{0});
}

}  // namespace spikeserve
