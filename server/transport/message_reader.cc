#include "server/transport/message_reader.h"

#include <algorithm>

#include "server/transport/grpc_wire.h"

namespace spikeserve {
namespace {

// A larger buffer is freed after its message.
constexpr size_t kKeptCapacity = 4096;

}  // namespace

bool MessageReader::Fill(absl::string_view* data, size_t size) {
  if (buffer_.size() < size) {
    const size_t count = std::min(size - buffer_.size(), data->size());
    buffer_.append(data->data(), count);
    data->remove_prefix(count);
  }
  return buffer_.size() >= size;
}

std::optional<MessageReader::Item> MessageReader::Next(absl::string_view* data, size_t limit) {
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

}  // namespace spikeserve
