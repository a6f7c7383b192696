// The messages of a call in one piece of memory, instead of one allocation for each of their parts.
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
  // A call's messages, from before its request is read until its answer has been sent.
  class Holder final : public grpc::MessageHolder<Request, Response> {
   public:
    Holder() : arena_(block_, sizeof(block_)) {
      this->set_request(google::protobuf::Arena::CreateMessage<Request>(&arena_));
      this->set_response(google::protobuf::Arena::CreateMessage<Response>(&arena_));
    }
    void Release() override { delete this; }  // gRPC's holders own themselves

   private:
    alignas(std::max_align_t) char block_[2048];  // an Act fits; a batch goes on elsewhere
    google::protobuf::Arena arena_;
  };
};

}  // namespace spikeserve

#endif  // SERVER_RPC_ARENA_MESSAGES_H_
