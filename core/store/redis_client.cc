#include "core/store/redis_client.h"

#include <algorithm>
#include <utility>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

constexpr int kMostRedirections = 5;

absl::Status Unavailable(absl::string_view what) {
  return absl::UnavailableError(absl::StrCat("session store: ", what));
}

bool IsArray(const redisReply& reply, size_t least) {
  return reply.type == REDIS_REPLY_ARRAY && reply.elements >= least;
}

}  // namespace

// CRC16 with the polynomial x^16 + x^12 + x^5 + 1 (XMODEM), as the Cluster's specification says.
uint16_t RedisSlot(absl::string_view key) {
  const size_t open = key.find('{');
  if (open != absl::string_view::npos) {
    const size_t close = key.find('}', open + 1);
    if (close != absl::string_view::npos && close > open + 1) {
      key = key.substr(open + 1, close - open - 1);
    }
  }
  uint32_t crc = 0;
  for (const char c : key) {
    crc ^= static_cast<uint32_t>(static_cast<uint8_t>(c)) << 8;
    for (int bit = 0; bit < 8; ++bit) crc = (crc & 0x8000) != 0 ? (crc << 1) ^ 0x1021 : crc << 1;
    crc &= 0xffff;
  }
  return static_cast<uint16_t>(crc % RedisClient::kSlots);
}

absl::StatusOr<std::unique_ptr<RedisClient>> RedisClient::Connect(const RedisOptions& options) {
  absl::Status status;
  for (const RedisEndpoint& endpoint : options.address.endpoints) {
    auto client = std::unique_ptr<RedisClient>(new RedisClient(options));
    status = options.address.primary.empty() ? client->ConnectTo(endpoint)
                                             : client->ConnectBySentinel(endpoint);
    if (status.ok()) return client;
  }
  return status;
}

absl::Status RedisClient::ConnectBySentinel(const RedisEndpoint& sentinel) {
  ASSIGN_OR_RETURN(const auto connection,
                   RedisConnection::Connect(sentinel, options_, RedisPeer::kSentinel));
  const std::string& name = options_.address.primary;
  ASSIGN_OR_RETURN(const auto reply,
                   connection->Run({"SENTINEL", "get-master-addr-by-name", name}));
  RedisEndpoint primary;
  if (!IsArray(*reply, 2) || !absl::SimpleAtoi(TextOf(*reply->element[1]), &primary.port)) {
    return Unavailable(absl::StrCat("Sentinel ", sentinel.ToString(), " knows no primary ", name));
  }
  primary.host = std::string(TextOf(*reply->element[0]));
  return ConnectTo(primary);
}

absl::Status RedisClient::ConnectTo(const RedisEndpoint& endpoint) {
  Node& node = NodeAt(endpoint);
  RETURN_IF_ERROR(Connect(node, &node.connection));
  RedisConnection& connection = *node.connection;
  // A server that is no node of a Cluster answers with an error.
  connection.Append(FormatRedisCommand({"CLUSTER", "SLOTS"}));
  ASSIGN_OR_RETURN(const auto slots, connection.Read());
  if (slots->type == REDIS_REPLY_ARRAY) {
    return ReadSlots(*slots, endpoint);
  }
  // A former primary that came back is a replica, which refuses writes.
  connection.Append(FormatRedisCommand({"ROLE"}));
  ASSIGN_OR_RETURN(const auto role, connection.Read());
  if (IsArray(*role, 1) && TextOf(*role->element[0]) != "master") {
    return Unavailable(absl::StrCat(endpoint.ToString(), " is no primary"));
  }
  only_ = &node;
  return absl::OkStatus();
}

absl::Status RedisClient::ReadSlots(const redisReply& reply, const RedisEndpoint& asked) {
  slots_.assign(kSlots, nullptr);
  for (size_t i = 0; i < reply.elements; ++i) {
    const redisReply& range = *reply.element[i];
    if (!IsArray(range, 3) || !IsArray(*range.element[2], 2)) continue;
    const int64_t first = range.element[0]->integer;
    const int64_t last = range.element[1]->integer;
    const int64_t port = range.element[2]->element[1]->integer;
    if (first < 0 || first > last || last >= int64_t{kSlots}) {
      return Unavailable(absl::StrCat(asked.ToString(), ": expected slots from 0 to ", kSlots - 1,
                                      ", received ", first, " to ", last));
    }
    if (port < 1 || port > kLargestPort) {
      return Unavailable(absl::StrCat(asked.ToString(), ": expected a port from 1 to ",
                                      kLargestPort, ", received ", port));
    }
    RedisEndpoint endpoint = {.host = std::string(TextOf(*range.element[2]->element[0])),
                              .port = static_cast<int>(port)};
    if (endpoint.host.empty()) endpoint.host = asked.host;  // a node that does not know its address
    Node& node = NodeAt(endpoint);
    for (int64_t slot = first; slot <= last; ++slot) slots_[static_cast<size_t>(slot)] = &node;
  }
  return absl::OkStatus();
}

RedisClient::Node& RedisClient::NodeAt(const RedisEndpoint& endpoint) {
  Node& node = nodes_[endpoint.ToString()];
  node.endpoint = endpoint;
  return node;
}

RedisClient::Node& RedisClient::NodeOf(absl::string_view key) {
  Node* const node = is_cluster() ? slots_[RedisSlot(key)] : only_;
  return node == nullptr ? nodes_.begin()->second : *node;  // which shows where the slot is
}

absl::StatusOr<std::unique_ptr<RedisConnection>> RedisClient::NewConnection(
    const RedisEndpoint& endpoint) {
  auto connected = RedisConnection::Connect(endpoint, options_, RedisPeer::kRedis);
  if (!connected.ok() || options_.address.database == 0) return connected;
  RETURN_IF_ERROR((*connected)->Run({"SELECT", absl::StrCat(options_.address.database)}).status());
  return connected;
}

absl::Status RedisClient::Connect(Node& node, std::unique_ptr<RedisConnection>* connection) {
  // One try: otherwise every command of a long pipeline would wait for a node that is away.
  if (*connection != nullptr || !node.failure.ok()) return node.failure;
  auto connected = NewConnection(node.endpoint);
  node.failure = connected.status();
  if (connected.ok()) *connection = *std::move(connected);
  return node.failure;
}

bool RedisClient::Node::is_usable() const {
  return failure.ok() && (connection == nullptr || connection->failure().ok()) &&
         (redirected == nullptr || redirected->failure().ok());
}

bool RedisClient::is_usable() const {
  return pending_.empty() && std::all_of(nodes_.begin(), nodes_.end(),
                                         [](const auto& node) { return node.second.is_usable(); });
}

void RedisClient::Append(std::initializer_list<absl::string_view> arguments) {
  const absl::string_view* const first = arguments.begin();
  Node& node = NodeOf(first[*first == "EVAL" ? 3 : 1]);
  Pending& pending = pending_.emplace_back();
  pending.node = &node;
  pending.failure = Connect(node, &node.connection);
  if (!pending.failure.ok()) return;
  std::string command = FormatRedisCommand(arguments);
  node.connection->Append(command);
  if (options_.replicas > 0) written_.insert(node.connection.get());
  if (is_cluster()) pending.command = std::move(command);
}

absl::StatusOr<RedisReply> RedisClient::Read() {
  const Pending pending = std::move(pending_.front());
  pending_.pop_front();
  if (!pending.failure.ok()) return pending.failure;
  auto reply = pending.node->connection->Read();
  if (!reply.ok()) return reply;
  Redirection redirection;
  if (is_cluster() && ParseRedirection(**reply, pending.node->endpoint, &redirection)) {
    return Follow(pending.command, std::move(redirection));
  }
  RETURN_IF_ERROR(RedisStatus(**reply));
  return reply;
}

absl::StatusOr<RedisReply> RedisClient::Run(std::initializer_list<absl::string_view> arguments) {
  Append(arguments);
  return Read();
}

// Parses "MOVED 3999 127.0.0.1:6381" and "ASK 3999 127.0.0.1:6381".
bool RedisClient::ParseRedirection(const redisReply& reply, const RedisEndpoint& from,
                                   Redirection* redirection) {
  if (reply.type != REDIS_REPLY_ERROR) return false;
  const std::vector<absl::string_view> words = absl::StrSplit(TextOf(reply), ' ');
  if (words.size() != 3 || (words[0] != "MOVED" && words[0] != "ASK")) return false;
  const size_t colon = words[2].rfind(':');
  uint32_t slot = 0;
  if (colon == absl::string_view::npos || !absl::SimpleAtoi(words[1], &slot) || slot >= kSlots ||
      !absl::SimpleAtoi(words[2].substr(colon + 1), &redirection->endpoint.port)) {
    return false;
  }
  redirection->is_ask = words[0] == "ASK";
  redirection->slot = static_cast<uint16_t>(slot);
  redirection->endpoint.host = std::string(words[2].substr(0, colon));
  if (redirection->endpoint.host.empty()) redirection->endpoint.host = from.host;
  return true;
}

absl::StatusOr<RedisReply> RedisClient::Follow(const std::string& command,
                                               Redirection redirection) {
  for (int i = 0; i < kMostRedirections; ++i) {
    Node& node = NodeAt(redirection.endpoint);
    RETURN_IF_ERROR(Connect(node, &node.redirected));
    if (!redirection.is_ask) slots_[redirection.slot] = &node;
    RedisConnection& connection = *node.redirected;
    if (redirection.is_ask) {
      if (const auto asking = connection.Run({"ASKING"}); !asking.ok()) return asking.status();
    }
    if (options_.replicas > 0) written_.insert(&connection);
    connection.Append(command);
    auto reply = connection.Read();
    if (!reply.ok()) return reply;
    if (ParseRedirection(**reply, node.endpoint, &redirection)) continue;
    RETURN_IF_ERROR(RedisStatus(**reply));
    return reply;
  }
  return Unavailable(absl::StrCat("expected at most ", kMostRedirections,
                                  " redirections of a command, received more"));
}

absl::Status RedisClient::ScanKeys(absl::string_view pattern,
                                   absl::FunctionRef<void(absl::string_view key)> visit) {
  SPIKESERVE_DCHECK(is_usable());
  std::set<Node*> primaries(slots_.begin(), slots_.end());
  if (!is_cluster()) primaries.insert(only_);
  primaries.erase(nullptr);
  for (Node* node : primaries) {
    RETURN_IF_ERROR(Connect(*node, &node->connection));
    RETURN_IF_ERROR(ScanNode(*node->connection, pattern, visit));
  }
  return absl::OkStatus();
}

absl::Status RedisClient::ScanNode(RedisConnection& connection, absl::string_view pattern,
                                   absl::FunctionRef<void(absl::string_view key)> visit) {
  std::string cursor = "0";
  do {
    ASSIGN_OR_RETURN(const auto reply,
                     connection.Run({"SCAN", cursor, "MATCH", pattern, "COUNT", "1000"}));
    if (!IsArray(*reply, 2)) return Unavailable("expected a cursor and keys");
    cursor = std::string(TextOf(*reply->element[0]));
    const redisReply& keys = *reply->element[1];
    for (size_t i = 0; i < keys.elements; ++i) visit(TextOf(*keys.element[i]));
  } while (cursor != "0");
  return absl::OkStatus();
}

absl::Status RedisClient::WaitForReplicas() {
  SPIKESERVE_DCHECK(is_usable());
  const auto connections = std::exchange(written_, {});
  const std::string replicas = absl::StrCat(options_.replicas);
  // The replicas have less time than Redis has for its answer.
  const std::string timeout = absl::StrCat(absl::ToInt64Milliseconds(options_.timeout / 2));
  for (RedisConnection* connection : connections) {
    connection->Append(FormatRedisCommand({"WAIT", replicas, timeout}));
  }
  absl::Status outcome;
  for (RedisConnection* connection : connections) {
    ASSIGN_OR_RETURN(const auto reply, connection->Read());
    RETURN_IF_ERROR(RedisStatus(*reply));
    if (reply->integer >= options_.replicas) continue;
    outcome =
        Unavailable(absl::StrCat(connection->endpoint().ToString(), ": expected ", replicas,
                                 " replicas that have the records, received ", reply->integer));
  }
  return outcome;
}

}  // namespace spikeserve
