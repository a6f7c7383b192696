#include "server/transport/frame_memory.h"

#include <sys/mman.h>

#include <algorithm>
#include <cstdlib>
#include <cstring>

#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

// The frame buffer is the only allocation of this size that a session makes when it starts.
constexpr size_t kFrameBufferBytes = 16 << 10;

}  // namespace

FrameMemory::FrameMemory()
    : allocator_{.mem_user_data = this,
                 .malloc = &Allocate,
                 .free = &Free,
                 .calloc = &AllocateZeros,
                 .realloc = &Reallocate} {}

FrameMemory::~FrameMemory() {
  SPIKESERVE_DCHECK(buffer_ == nullptr);  // the session, which is destroyed first, has freed it
  if (buffer_ != nullptr) munmap(buffer_, buffer_size_);
}

void FrameMemory::Release() {
  if (buffer_ != nullptr) madvise(buffer_, buffer_size_, MADV_DONTNEED);
}

void* FrameMemory::Map(size_t size) {
  void* pages =
      mmap(nullptr, size, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, /*fd=*/-1, 0);
  if (pages == MAP_FAILED) return nullptr;
  buffer_ = pages;
  buffer_size_ = size;
  return pages;
}

void* FrameMemory::Allocate(size_t size, void* self) {
  auto* memory = static_cast<FrameMemory*>(self);
  if (size < kFrameBufferBytes || memory->buffer_ != nullptr) return std::malloc(size);
  return memory->Map(size);
}

void FrameMemory::Free(void* memory, void* self) {
  auto* owner = static_cast<FrameMemory*>(self);
  if (memory == nullptr || memory != owner->buffer_) return std::free(memory);
  munmap(memory, owner->buffer_size_);
  owner->buffer_ = nullptr;
}

void* FrameMemory::AllocateZeros(size_t count, size_t size, void* /*self*/) {
  return std::calloc(count, size);
}

void* FrameMemory::Reallocate(void* memory, size_t size, void* self) {
  if (memory == nullptr) return Allocate(size, self);  // so nghttp2 allocates the frame buffer
  auto* owner = static_cast<FrameMemory*>(self);
  if (memory != owner->buffer_) return std::realloc(memory, size);
  void* moved = std::malloc(size);
  if (moved == nullptr) return nullptr;
  std::memcpy(moved, memory, std::min(size, owner->buffer_size_));
  Free(memory, self);
  return moved;
}

}  // namespace spikeserve
