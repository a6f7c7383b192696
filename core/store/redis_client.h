// Sends commands to a Redis server, to the primary that Sentinel names, or to the nodes of a
// Cluster, which is recognised by itself.
//
//   auto client = RedisClient::Connect(options);
//   (*client)->Append({"RPUSHX", key, value});
//   auto reply = (*client)->Read();
//
// In a Cluster, each command goes to the node that has its key, and MOVED and ASK are followed. The
// keys of one command must lie in one slot. Commands on keys of one slot run in their order.
//
// Not thread-safe. All methods but Append() block for at most a few
// RedisOptions::timeout.
#pragma once

#include <cstdint>
#include <deque>
#include <initializer_list>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <vector>

#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "core/store/redis_connection.h"
#include "core/store/redis_options.h"

namespace spikeserve {

// Returns the slot of a key in a Cluster: of the text in its first braces, if there is any.
uint16_t RedisSlot(absl::string_view key);

class RedisClient {
 public:
  static constexpr size_t kSlots = 16384;

  // Returns UNAVAILABLE if no server can be used.
  static absl::StatusOr<std::unique_ptr<RedisClient>> Connect(const RedisOptions& options);

  // The key is argument 1; of EVAL, argument 3.
  void Append(std::initializer_list<absl::string_view> arguments);

  // Returns the reply to the oldest command without one. Returns UNAVAILABLE if the server answers
  // with an error or not at all. If it does not answer, all later commands to it fail, too.
  absl::StatusOr<RedisReply> Read();

  // Returns whether the replies to further commands can be told from those to earlier ones: all
  // were read, and each server has answered. Otherwise the client is of no further use.
  bool is_usable() const;

  bool is_cluster() const { return !slots_.empty(); }

  absl::StatusOr<RedisReply> Run(std::initializer_list<absl::string_view> arguments);

  // Calls `visit` for every key that matches the pattern, once or more. REQUIRES: is_usable().
  absl::Status ScanKeys(absl::string_view pattern,
                        absl::FunctionRef<void(absl::string_view key)> visit);

  // Waits until RedisOptions::replicas replicas have all writes so far. UNAVAILABLE if fewer do.
  // REQUIRES: is_usable().
  absl::Status WaitForReplicas();

 private:
  struct Node {
    RedisEndpoint endpoint;
    std::unique_ptr<RedisConnection> connection;  // null: not connected yet
    // For commands that another node sent here, so that their replies do not mix with others.
    std::unique_ptr<RedisConnection> redirected;
    absl::Status failure;  // of the last try to connect, which is the last one if it has failed

    bool is_usable() const;
  };
  // A command whose reply was not read yet.
  struct Pending {
    Node* node = nullptr;
    std::string command;   // empty without a Cluster
    absl::Status failure;  // not OK: it was not sent
  };
  struct Redirection {
    bool is_ask = false;
    uint16_t slot = 0;
    RedisEndpoint endpoint;
  };

  explicit RedisClient(RedisOptions options) : options_(std::move(options)) {}

  absl::Status ConnectBySentinel(const RedisEndpoint& sentinel);
  absl::Status ConnectTo(const RedisEndpoint& endpoint);
  // Fills the table of slots from the reply to CLUSTER SLOTS. `asked` sent it. Returns UNAVAILABLE
  // if it names slots or ports that there are not.
  absl::Status ReadSlots(const redisReply& reply, const RedisEndpoint& asked);
  Node& NodeAt(const RedisEndpoint& endpoint);
  Node& NodeOf(absl::string_view key);
  // Connects if `connection` is null, one of `node`.
  absl::Status Connect(Node& node, std::unique_ptr<RedisConnection>* connection);
  absl::StatusOr<std::unique_ptr<RedisConnection>> NewConnection(const RedisEndpoint& endpoint);
  // Returns true if `reply` sends its command to another node.
  static bool ParseRedirection(const redisReply& reply, const RedisEndpoint& from,
                               Redirection* redirection);
  static absl::Status ScanNode(RedisConnection& connection, absl::string_view pattern,
                               absl::FunctionRef<void(absl::string_view key)> visit);
  absl::StatusOr<RedisReply> Follow(const std::string& command, Redirection redirection);

  const RedisOptions options_;
  std::map<std::string, Node> nodes_;  // by address
  Node* only_ = nullptr;               // without a Cluster
  std::vector<Node*> slots_;           // empty without a Cluster; null: a slot of no node
  std::deque<Pending> pending_;
  std::set<RedisConnection*> written_;  // since the last WaitForReplicas()
};

}  // namespace spikeserve
