#include "tests/unit/agent/allocation_counter.h"

#include <cstdlib>
#include <new>

namespace {

thread_local int64_t allocations = 0;

}  // namespace

int64_t spikeserve::Allocations() { return allocations; }

// The linker's --wrap=malloc sends calls of malloc to __wrap_malloc.
extern "C" void* __real_malloc(size_t size);
extern "C" void* __wrap_malloc(size_t size) {
  ++allocations;
  return __real_malloc(size);
}

void* operator new(size_t size) {
  if (void* memory = std::malloc(size)) return memory;
  throw std::bad_alloc();
}
void operator delete(void* memory) noexcept { std::free(memory); }
void operator delete(void* memory, size_t /*size*/) noexcept { std::free(memory); }
