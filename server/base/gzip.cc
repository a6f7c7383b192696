#include "server/base/gzip.h"

#include <zlib.h>

#include <algorithm>
#include <memory>

#include "absl/status/status.h"

namespace spikeserve {
namespace {

constexpr int kGzipWindow = 15 + 16;  // the largest window; 16: the format is gzip
constexpr size_t kFirstBytes = 4 << 10;

struct EndInflate {
  void operator()(z_stream* stream) const { inflateEnd(stream); }
};

}  // namespace

absl::StatusOr<std::string> Gunzip(absl::string_view compressed, size_t limit) {
  z_stream stream = {};
  if (inflateInit2(&stream, kGzipWindow) != Z_OK) {
    return absl::ResourceExhaustedError("gzip: no memory to decompress with; try again later");
  }
  const std::unique_ptr<z_stream, EndInflate> ends(&stream);
  stream.next_in = reinterpret_cast<Bytef*>(const_cast<char*>(compressed.data()));
  stream.avail_in = static_cast<uInt>(compressed.size());

  std::string bytes;
  size_t size = 0;
  int result = Z_OK;
  while (result == Z_OK && size <= limit) {
    // One byte beyond the limit shows that there are too many.
    bytes.resize(std::min(std::max(kFirstBytes, 2 * size), limit + 1));
    stream.next_out = reinterpret_cast<Bytef*>(bytes.data() + size);
    stream.avail_out = static_cast<uInt>(bytes.size() - size);
    result = inflate(&stream, Z_NO_FLUSH);
    size = bytes.size() - stream.avail_out;
  }
  if (size > limit) return absl::ResourceExhaustedError("gzip: more bytes than are accepted");
  if (result != Z_STREAM_END || stream.avail_in > 0) {
    return absl::InvalidArgumentError("gzip: expected one complete member of the gzip format");
  }
  bytes.resize(size);
  return bytes;
}

}  // namespace spikeserve
