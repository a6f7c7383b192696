// The request and the response of one call in one block of memory.
//
// Not thread-safe.
#pragma once

#include <google/protobuf/arena.h>
#include <google/protobuf/message.h>

#include <cstddef>
#include <cstdint>

namespace spikeserve {

class CallMessages {
 public:
  using Message = google::protobuf::Message;

  // The messages have the types of `request` and `response`, which must outlive this object.
  CallMessages(const Message& request, const Message& response)
      : request_type_(request),
        response_type_(response),
        arena_(block_, sizeof(block_)),
        request_(request.New(&arena_)),
        response_(response.New(&arena_)) {}
  CallMessages(const CallMessages&) = delete;
  CallMessages& operator=(const CallMessages&) = delete;

  Message* request() const { return request_; }
  Message* response() const { return response_; }

  // Returns the bytes that the messages occupy beside this object.
  int64_t extra_bytes() const {
    return static_cast<int64_t>(arena_.SpaceAllocated()) - static_cast<int64_t>(sizeof(block_));
  }

  // Frees the memory of both messages, which are empty then.
  void Free() {
    arena_.Reset();
    request_ = request_type_.New(&arena_);
    response_ = response_type_.New(&arena_);
  }

 private:
  const Message& request_type_;
  const Message& response_type_;
  // Holds an Act; the arena allocates more if needed.
  alignas(std::max_align_t) char block_[1536];
  google::protobuf::Arena arena_;
  Message* request_;
  Message* response_;
};

}  // namespace spikeserve
