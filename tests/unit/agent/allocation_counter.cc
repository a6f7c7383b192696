// Counts the allocations of a thread, for allocation_test.cc. Linking it replaces operator new in
// the whole program. malloc, which Eigen calls directly, is counted in the objects that are linked
// with --wrap=malloc.
#include <cstdint>
#include <cstdlib>
#include <new>

namespace {

thread_local int64_t allocations = 0;

}  // namespace

namespace spikeserve {
int64_t Allocations() { return allocations; }
}  // namespace spikeserve

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
