// The request and the response of one call in one block of memory.
//
// Not thread-safe.
#pragma once

#include <google/protobuf/arena.h>

#include <cstddef>
#include <cstdint>

namespace spikeserve {

template <typename Request, typename Response>
class CallMessages {
 public:
  CallMessages()
      : arena_(block_, sizeof(block_)),
        request_(google::protobuf::Arena::CreateMessage<Request>(&arena_)),
        response_(google::protobuf::Arena::CreateMessage<Response>(&arena_)) {}
  CallMessages(const CallMessages&) = delete;
  CallMessages& operator=(const CallMessages&) = delete;

  Request* request() { return request_; }
  Response* response() { return response_; }

  // Returns the bytes that the messages occupy beside this object.
  int64_t extra_bytes() const {
    return static_cast<int64_t>(arena_.SpaceAllocated()) - static_cast<int64_t>(sizeof(block_));
  }

  // Frees the memory of both messages, which are empty then.
  void Free() {
    arena_.Reset();
    request_ = google::protobuf::Arena::CreateMessage<Request>(&arena_);
    response_ = google::protobuf::Arena::CreateMessage<Response>(&arena_);
  }

 private:
  // Holds an Act; the arena allocates more if needed.
  alignas(std::max_align_t) char block_[1536];
  google::protobuf::Arena arena_;
  Request* request_;
  Response* response_;
};

}  // namespace spikeserve
