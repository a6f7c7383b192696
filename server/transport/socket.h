// A connected, non-blocking socket, with or without TLS.
//
// Not thread-safe.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>

#include "absl/strings/string_view.h"
#include "absl/types/span.h"
#include "server/access/tls_context.h"
#include "server/base/file_descriptor.h"

namespace spikeserve {

class Socket {
 public:
  enum class Outcome {
    kDone,     // `bytes` were transferred
    kBlocked,  // try again when the socket is ready
    kClosed,   // the peer has closed the connection, or it failed
  };
  struct Result {
    Outcome outcome;
    size_t bytes = 0;
  };

  virtual ~Socket() = default;

  virtual int fd() const = 0;
  virtual Result Read(absl::Span<char> buffer) = 0;
  virtual Result Write(absl::string_view data) = 0;

  // Tells the peer that no more bytes follow. Bytes can still be read.
  virtual void ShutDownWriting() = 0;

  // Returns about how many bytes the socket occupies.
  virtual int64_t overhead() const { return 0; }
  // Returns true until the TLS handshake is complete.
  virtual bool is_handshaking() const { return false; }
  // Returns true if a blocked Read() waits until the socket can be written.
  virtual bool read_waits_for_write() const { return false; }
  // Returns the subject of the client's certificate (RFC 2253); empty if it sent none.
  virtual std::string peer_subject() const { return ""; }
  // Returns true if bytes can be read although the file descriptor is not ready.
  virtual bool has_buffered_input() const { return false; }
};

std::unique_ptr<Socket> MakePlainSocket(FileDescriptor fd);

// Returns a socket that performs the server's side of the handshake in its first reads and writes.
// Returns null if OpenSSL has no memory.
std::unique_ptr<Socket> MakeTlsSocket(FileDescriptor fd, TlsContext* tls);

}  // namespace spikeserve
