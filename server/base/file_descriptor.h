// Owns a file descriptor.
#pragma once

#include <unistd.h>

#include <utility>

namespace spikeserve {

// Closes the descriptor when it goes out of scope. Not thread-safe.
class FileDescriptor {
 public:
  FileDescriptor() = default;
  // Takes ownership of `fd`; -1 means none.
  explicit FileDescriptor(int fd) : fd_(fd) {}
  FileDescriptor(FileDescriptor&& other) noexcept : fd_(std::exchange(other.fd_, -1)) {}
  FileDescriptor& operator=(FileDescriptor&& other) noexcept {
    std::swap(fd_, other.fd_);
    return *this;
  }
  ~FileDescriptor() { Close(); }

  int get() const { return fd_; }
  bool valid() const { return fd_ >= 0; }
  void Close() {
    if (fd_ >= 0) close(std::exchange(fd_, -1));
  }

 private:
  int fd_ = -1;
};

}  // namespace spikeserve
