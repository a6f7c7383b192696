// A socket whose client is an input: it hands out the bytes in pieces and takes every answer. The
// client of a fuzz target that has one connection.
#pragma once

#include <sys/eventfd.h>

#include <algorithm>
#include <cstdint>
#include <string>

#include "server/transport/connection_table.h"
#include "server/transport/socket.h"

namespace spikeserve {

// Not thread-safe. `answer` must outlive the socket.
class MemorySocket final : public Socket {
 public:
  // Hands out at most `piece` bytes in one Read(), at least one.
  MemorySocket(absl::string_view input, size_t piece, std::string* answer)
      : fd_(eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK)),
        rest_(input),
        piece_(std::max<size_t>(piece, 1)),
        answer_(*answer) {}

  int fd() const override { return fd_.get(); }

  Result Read(absl::Span<char> buffer) override {
    if (rest_.empty()) return {Outcome::kClosed};
    if (std::exchange(pauses_, !pauses_)) return {Outcome::kBlocked};
    const absl::string_view bytes = rest_.substr(0, std::min(piece_, buffer.size()));
    std::copy(bytes.begin(), bytes.end(), buffer.begin());
    rest_.remove_prefix(bytes.size());
    return {Outcome::kDone, bytes.size()};
  }

  Result Write(absl::string_view data) override {
    answer_.append(data.data(), data.size());
    return {Outcome::kDone, data.size()};
  }

  void ShutDownWriting() override {}

 private:
  const FileDescriptor fd_;  // to be watched
  absl::string_view rest_;
  const size_t piece_;
  std::string& answer_;
  bool pauses_ = false;  // at the next read
};

inline ClientOrigin OneClient() {
  return {.address = "192.0.2.1", .host = "192.0.2.1", .network = "192.0.2.0/24"};
}

// Closes nothing, because no other connection needs the place.
class NoCloser final : public ConnectionCloser {
 public:
  void CloseSoon(uint64_t /*number*/) override {}
};

}  // namespace spikeserve
