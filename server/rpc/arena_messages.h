// Allocates the messages of a call on a protobuf arena: one block of memory instead of one
// allocation for each field.
//
// Thread-safe.
#ifndef SERVER_RPC_ARENA_MESSAGES_H_
#define SERVER_RPC_ARENA_MESSAGES_H_

#include <google/protobuf/arena.h>
#include <grpcpp/support/message_allocator.h>

#include <cstddef>

namespace spikeserve {

template <typename Request, typename Response>
class ArenaMessages final : public grpc::MessageAllocator<Request, Response> {
 public:
  grpc::MessageHolder<Request, Response>* AllocateMessages() override { return new Holder; }

 private:
  // Owns the messages of one call from before the request is read until the answer has been sent.
  class Holder final : public grpc::MessageHolder<Request, Response> {
   public:
    Holder() : arena_(block_, sizeof(block_)) {
      this->set_request(google::protobuf::Arena::CreateMessage<Request>(&arena_));
      this->set_response(google::protobuf::Arena::CreateMessage<Response>(&arena_));
    }
    void Release() override { delete this; }  // gRPC calls this once, when the call is over

   private:
    alignas(
        std::max_align_t) char block_[2048];  // holds an Act; the arena allocates more if needed
    google::protobuf::Arena arena_;
  };
};

}  // namespace spikeserve

#endif  // SERVER_RPC_ARENA_MESSAGES_H_
