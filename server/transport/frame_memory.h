// The memory of one HTTP/2 session of nghttp2.
//
// nghttp2 keeps a buffer of 16 KiB for the frame that it sends next. Most connections are idle most
// of the time, so this buffer has pages of its own, which can be given back to the system.
//
// Not thread-safe.
#pragma once

#include <nghttp2/nghttp2.h>

#include <cstddef>

namespace spikeserve {

class FrameMemory {
 public:
  FrameMemory();
  // REQUIRES: the session was destroyed.
  ~FrameMemory();
  FrameMemory(const FrameMemory&) = delete;
  FrameMemory& operator=(const FrameMemory&) = delete;

  // The allocator of the session. Valid as long as this object.
  nghttp2_mem* allocator() { return &allocator_; }

  // Gives the pages of the frame buffer back; they return, as zeros, when they are used next.
  // REQUIRES: the session has nothing to send, so that the content of the buffer is not needed.
  void Release();

 private:
  static void* Allocate(size_t size, void* self);
  static void Free(void* memory, void* self);
  static void* AllocateZeros(size_t count, size_t size, void* self);
  static void* Reallocate(void* memory, size_t size, void* self);

  void* Map(size_t size);

  nghttp2_mem allocator_;
  void* buffer_ = nullptr;  // pages of the frame buffer; null: none is allocated
  size_t buffer_size_ = 0;
};

}  // namespace spikeserve
