// How to reach Redis: the parts of an address such as
//
//   redis://cache:6379/1                      one server, or any node of a Cluster
//   redis://node1,node2,node3                 the first that answers; for a Cluster
//   rediss://cache                            as above, over TLS
//   redis+sentinel://guard1,guard2/mymaster   the primary that Sentinel names
//   rediss+sentinel://guard1,guard2/mymaster  as above, over TLS to Sentinel and to Redis
//
// Plain data, safe to read from many threads.
#ifndef CORE_STORE_REDIS_OPTIONS_H_
#define CORE_STORE_REDIS_OPTIONS_H_

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "absl/strings/string_view.h"

namespace spikeserve {

inline constexpr int kRedisPort = 6379;
inline constexpr int kSentinelPort = 26379;

struct RedisEndpoint {
  std::string host;  // a name, an IPv4 address, or an IPv6 address without brackets
  int port = kRedisPort;

  std::string ToString() const;

  friend bool operator==(const RedisEndpoint&, const RedisEndpoint&) = default;
};

struct RedisAddress {
  std::vector<RedisEndpoint> endpoints;  // tried in order
  std::string primary = "";  // name of the primary; empty: the endpoints are not Sentinels
  int database = 0;
  bool tls = false;
};

// The forms of ParseRedisAddress(), for error messages.
inline constexpr char kRedisAddressForms[] =
    "redis://HOST[:PORT][,...][/DATABASE], redis+sentinel://HOST[:PORT][,...]/PRIMARY[/DATABASE], "
    "or these with rediss for TLS";

// Returns nullopt if `text` has another form than above.
std::optional<RedisAddress> ParseRedisAddress(absl::string_view text);

// PEM files for TLS, read at each connection.
struct RedisTlsFiles {
  std::string ca = "";           // authorities of the servers; empty: those of the system
  std::string certificate = "";  // of this client; empty: none
  std::string key = "";          // of `certificate`
};

struct RedisOptions {
  RedisAddress address;
  std::string password = "";  // of Redis, and of Sentinels that want one; empty: none
  RedisTlsFiles tls_files = {};
  int64_t replicas = 0;  // of Redis, that must have a write before it counts
};

}  // namespace spikeserve

#endif  // CORE_STORE_REDIS_OPTIONS_H_
