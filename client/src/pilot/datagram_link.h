// The robot's socket for datagrams, whose answers are passed on as they arrive.
//
// The socket is bound to no address: when the robot's own address changes, datagrams go on from the
// new one. A thread finds the server's address and receives.
//
// Thread-safe.
#pragma once

#include <sys/socket.h>

#include <cstdint>
#include <memory>
#include <string>
#include <thread>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/mutex.h"
#include "core/datagram/sealed_channel.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve::piloting {

class DatagramLink {
 public:
  // Called on the thread of the link, one call at a time, without its lock.
  class Listener {
   public:
    virtual ~Listener() = default;
    // `reply` answers the datagram of this number.
    virtual void OnDatagram(uint64_t number, const v1::ActResponse& reply) = 0;
  };

  // `listener` must outlive the link.
  explicit DatagramLink(Listener* listener) : listener_(listener) {}
  ~DatagramLink() { Stop(); }

  // Sends nothing any more. Blocks until the last call of the listener. Not for its thread.
  void Stop() ABSL_LOCKS_EXCLUDED(mutex_);

  // Sends on this channel from now on. Answers on the one before are still taken. Returns
  // INVALID_ARGUMENT that names the field if it is not valid.
  absl::Status SetChannel(const v1::DatagramChannel& channel) ABSL_LOCKS_EXCLUDED(mutex_);

  // Sends a request `copies` times without waiting. It is lost if the server's address is not known
  // yet, or the request is too long.
  void Send(uint64_t number, const v1::ActRequest& request, int copies) ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  // A file descriptor; -1: none.
  struct Descriptor {
    Descriptor() = default;
    explicit Descriptor(int opened) : fd(opened) {}
    ~Descriptor();
    Descriptor(const Descriptor&) = delete;
    Descriptor& operator=(const Descriptor&) = delete;
    int fd = -1;
  };

  static int MakeWakeup();
  void Run() ABSL_LOCKS_EXCLUDED(mutex_);
  // Opens a socket for the host of the channel, if there is none. Returns it, or null.
  std::shared_ptr<Descriptor> FindServer() ABSL_LOCKS_EXCLUDED(mutex_);
  void Receive(absl::string_view datagram) ABSL_LOCKS_EXCLUDED(mutex_);

  Listener* const listener_;
  const Descriptor wakeup_{MakeWakeup()};  // an eventfd: there is another channel, or the end

  absl::Mutex mutex_;
  std::string endpoint_ ABSL_GUARDED_BY(mutex_);
  std::unique_ptr<SealedChannel> channel_ ABSL_GUARDED_BY(mutex_);
  std::unique_ptr<SealedChannel> former_ ABSL_GUARDED_BY(mutex_);
  std::shared_ptr<Descriptor> socket_ ABSL_GUARDED_BY(mutex_);  // null: the server is not found
  sockaddr_storage address_ ABSL_GUARDED_BY(mutex_) = {};
  socklen_t address_size_ ABSL_GUARDED_BY(mutex_) = 0;
  bool is_stopping_ ABSL_GUARDED_BY(mutex_) = false;
  std::thread thread_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve::piloting
