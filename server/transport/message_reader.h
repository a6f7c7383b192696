// Splits the bytes of a gRPC request stream into messages.
//
// Not thread-safe.
#pragma once

#include <algorithm>
#include <cstddef>
#include <optional>
#include <string>

#include "absl/strings/string_view.h"
#include "server/transport/grpc_wire.h"

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
  std::optional<Item> Next(absl::string_view* data, size_t limit) {
    if (returned_) {
      buffer_.clear();
      if (buffer_.capacity() > kKeptCapacity) buffer_.shrink_to_fit();
      returned_ = false;
    }
    const size_t dropped = std::min(to_drop_, data->size());
    data->remove_prefix(dropped);
    to_drop_ -= dropped;
    if (data->empty()) return std::nullopt;

    const bool in_place = buffer_.empty() && data->size() >= kMessagePrefixBytes;
    if (!in_place && !Fill(data, kMessagePrefixBytes)) return std::nullopt;
    const MessagePrefix prefix = ParseMessagePrefix(in_place ? *data : buffer_);
    Item item = {.length = prefix.length, .message = {}, .compressed = prefix.compressed};
    if (prefix.length > limit) {
      if (in_place) data->remove_prefix(kMessagePrefixBytes);
      buffer_.clear();
      to_drop_ = prefix.length;
      item.too_long = true;
      return item;
    }
    const size_t size = kMessagePrefixBytes + prefix.length;
    if (in_place && data->size() >= size) {
      item.message = data->substr(kMessagePrefixBytes, prefix.length);
      data->remove_prefix(size);
      return item;
    }
    if (!Fill(data, size)) return std::nullopt;
    item.message = absl::string_view(buffer_).substr(kMessagePrefixBytes);
    returned_ = true;
    return item;
  }

  // Returns the number of bytes that are stored.
  size_t buffered() const { return returned_ ? 0 : buffer_.size(); }

  // Returns true if the stream may end here, that is, between two messages.
  bool at_boundary() const { return buffered() == 0 && to_drop_ == 0; }

 private:
  // A larger buffer is freed after its message.
  static constexpr size_t kKeptCapacity = 4096;

  // Moves bytes from `data` to the buffer until it holds `size`. Returns true if it does.
  bool Fill(absl::string_view* data, size_t size) {
    if (buffer_.size() < size) {
      const size_t count = std::min(size - buffer_.size(), data->size());
      buffer_.append(data->data(), count);
      data->remove_prefix(count);
    }
    return buffer_.size() >= size;
  }

  std::string buffer_;     // prefix and message, as far as received
  bool returned_ = false;  // the message in the buffer was returned and is stale now
  size_t to_drop_ = 0;     // bytes of a message that is too long and have not arrived yet
};

}  // namespace spikeserve
