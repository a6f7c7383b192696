// How to reach Redis: the parts of an address such as
//
//   redis://cache:6379/1                      one server, or any node of a Cluster
//   redis://robots@cache                      as the user `robots` of its access control list
//   redis://node1,node2,node3                 the first that answers; for a Cluster
//   rediss://cache                            as above, over TLS
//   redis+sentinel://guard1,guard2/mymaster   the primary that Sentinel names
//   rediss+sentinel://guard1,guard2/mymaster  as above, over TLS to Sentinel and to Redis
//
// Plain data, safe to read from many threads.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"

namespace spikeserve {

inline constexpr int kRedisPort = 6379;
inline constexpr int kSentinelPort = 26379;
inline constexpr int kLargestPort = 65535;
inline constexpr absl::Duration kDefaultRedisTimeout = absl::Seconds(1);

struct RedisEndpoint {
  std::string host;  // a name, an IPv4 address, or an IPv6 address without brackets
  int port = kRedisPort;

  std::string ToString() const;

  friend bool operator==(const RedisEndpoint&, const RedisEndpoint&) = default;
};

struct RedisAddress {
  std::vector<RedisEndpoint> endpoints;  // tried in order
  std::string user = "";                 // of the access control list; empty: the default user
  std::string primary = "";  // name of the primary; empty: the endpoints are not Sentinels
  int database = 0;
  bool tls = false;
};

// The forms of ParseRedisAddress(), for error messages.
inline constexpr char kRedisAddressForms[] =
    "redis://[USER@]HOST[:PORT][,...][/DATABASE], "
    "redis+sentinel://[USER@]HOST[:PORT][,...]/PRIMARY[/DATABASE], or these with rediss for TLS";

// Returns nullopt if `text` has another form than above.
std::optional<RedisAddress> ParseRedisAddress(absl::string_view text);

// Returns INVALID_ARGUMENT if there is a password in an address of Redis, which would be visible in
// the list of processes and on the status page. The error does not repeat it.
absl::Status CheckNoRedisPassword(absl::string_view text);

// PEM files for TLS, read at each connection.
struct RedisTlsFiles {
  std::string ca = "";           // authorities of the servers; empty: those of the system
  std::string certificate = "";  // of this client; empty: none
  std::string key = "";          // of `certificate`
};

// Returns the password in a file, without white space around it, or empty if `file` is. NOT_FOUND,
// which names the flag, if it cannot be read.
absl::StatusOr<std::string> ReadRedisPassword(const std::string& file);

struct RedisOptions {
  RedisAddress address;
  // With the password of Redis, and of Sentinels that want one; read at each connection, so that it
  // can be renewed. Empty: none.
  std::string password_file = "";
  // The longest time without a byte of an answer. A whole reply may take
  // RedisConnection::kTimeoutsOfReply times as long.
  absl::Duration timeout = kDefaultRedisTimeout;
  RedisTlsFiles tls_files = {};
  int64_t replicas = 0;  // of Redis, that must have a write before it counts
};

}  // namespace spikeserve
