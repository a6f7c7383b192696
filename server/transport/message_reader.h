// Splits the bytes of a gRPC request stream into messages.
//
// Not thread-safe.
#pragma once

#include <cstddef>
#include <optional>
#include <string>

#include "absl/strings/string_view.h"

namespace spikeserve {

// Stores the bytes of one incomplete message at most. A message that arrives in one piece is not
// copied.
class MessageReader {
 public:
  struct Item {
    size_t length = 0;          // of the message, as its prefix announces
    absl::string_view message;  // valid until the next call of Next(); empty if `too_long`
    bool compressed = false;    // as its prefix announces
    bool too_long = false;
  };

  // Takes bytes from the front of `data` until a message is complete, and returns it. Returns
  // nothing once `data` is empty. A message longer than `limit` is returned as soon as its prefix
  // is complete, and its bytes are dropped.
  std::optional<Item> Next(absl::string_view* data, size_t limit);

  // Returns the number of bytes that are stored.
  size_t buffered() const { return returned_ ? 0 : buffer_.size(); }

  // Returns true if the stream may end here, that is, between two messages.
  bool at_boundary() const { return buffered() == 0 && to_drop_ == 0; }

 private:
  // Moves bytes from `data` to the buffer until it holds `size`. Returns true if it does.
  bool Fill(absl::string_view* data, size_t size);

  std::string buffer_;     // prefix and message, as far as received
  bool returned_ = false;  // the message in the buffer was returned and is stale now
  size_t to_drop_ = 0;     // bytes of a message that is too long and have not arrived yet
};

}  // namespace spikeserve
