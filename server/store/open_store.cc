#include "server/store/open_store.h"

#include <algorithm>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/strings/strip.h"
#include "absl/time/clock.h"
#include "core/base/clock.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/session/session_id.h"
#include "core/store/redis_tls.h"
#include "server/store/file_backend.h"
#include "server/store/redis_backend.h"

namespace spikeserve {
namespace {

constexpr char kAddressFlag[] = "--session_store";
constexpr char kPasswordFlag[] = "--store_password_file";
constexpr char kUserFlag[] = "--store_user";
constexpr char kTimeoutFlag[] = "--store_timeout";
constexpr char kReplicasFlag[] = "--store_replicas";

constexpr absl::Duration kShortestTimeout = absl::Milliseconds(10);

// What stays for ever stays for a century: Redis refuses an expiry beyond what its clock can tell.
constexpr absl::Duration kLongestRetention = absl::Hours(24 * 36525);

// Returns INVALID_ARGUMENT unless the options of Redis fit its address.
absl::Status CheckRedisOptions(const StoreOptions& options, const StoreAddress& address) {
  const bool is_redis = address.kind == StoreAddress::Kind::kRedis;
  const auto refuse = [](absl::string_view flag, absl::string_view expected, auto received) {
    return InvalidArgument(flag, expected, received);
  };
  if (!is_redis && !options.password_file.empty()) {
    return refuse(kPasswordFlag, "none without a store in Redis", options.password_file);
  }
  if (!options.user.empty() && !is_redis) {
    return refuse(kUserFlag, "none without a store in Redis", options.user);
  }
  if (!options.user.empty() && !address.redis.user.empty()) {
    return refuse(kUserFlag, "none, because --session_store names one", options.user);
  }
  if (options.timeout < kShortestTimeout) {
    return refuse(kTimeoutFlag, absl::StrCat("at least ", absl::FormatDuration(kShortestTimeout)),
                  absl::FormatDuration(options.timeout));
  }
  if (options.timeout == absl::InfiniteDuration()) {
    return refuse(kTimeoutFlag, "a finite duration", "inf");
  }
  if (!is_redis && options.may_evict) {
    return refuse("--store_may_evict", "false without a store in Redis", "true");
  }
  if (options.replicas < 0 || (!is_redis && options.replicas > 0)) {
    return refuse(kReplicasFlag, is_redis ? "at least 0" : "0 without a store in Redis",
                  options.replicas);
  }
  const RedisTlsFiles& files = options.tls_files;
  for (const auto& [flag, file] :
       {std::pair("--store_ca", &files.ca), std::pair("--store_certificate", &files.certificate),
        std::pair("--store_key", &files.key)}) {
    if (!file->empty() && !address.redis.tls) {
      return refuse(flag, "none unless --session_store begins with rediss", *file);
    }
  }
  if (files.certificate.empty() != files.key.empty()) {
    return refuse("--store_certificate, --store_key", "both or none", "one");
  }
  return address.redis.tls ? CheckRedisTlsFiles(files) : absl::OkStatus();
}

absl::StatusOr<RedisOptions> ReadRedisOptions(RedisAddress address, const StoreOptions& options) {
  RedisOptions redis = {.address = std::move(address),
                        .timeout = options.timeout,
                        .tls_files = options.tls_files,
                        .replicas = options.replicas};
  if (!options.user.empty()) redis.address.user = options.user;
  redis.password_file = options.password_file;
  RETURN_IF_ERROR(
      ReadRedisPassword(redis.password_file).status());  // what is wrong now is an error
  return redis;
}

}  // namespace

absl::StatusOr<StoreAddress> ParseStoreAddress(const std::string& text) {
  if (text == "memory") return StoreAddress();
  absl::string_view rest = text;
  if (absl::ConsumePrefix(&rest, "file:") && !rest.empty()) {
    return StoreAddress{.kind = StoreAddress::Kind::kFile, .folder = std::string(rest)};
  }
  RETURN_IF_ERROR(CheckNoRedisPassword(text));
  if (auto redis = ParseRedisAddress(text); redis.has_value()) {
    return StoreAddress{.kind = StoreAddress::Kind::kRedis, .redis = *std::move(redis)};
  }
  return absl::InvalidArgumentError(
      absl::StrCat("expected memory, file:DIR, ", kRedisAddressForms, ", received ", Quoted(text)));
}

absl::Status StoreOptions::Validate() const {
  const auto parsed = ParseStoreAddress(address);
  if (!parsed.ok()) return Annotate(parsed.status(), kAddressFlag);
  return CheckRedisOptions(*this, *parsed);
}

absl::StatusOr<std::optional<RedisOptions>> RedisOptionsOf(const StoreOptions& options) {
  auto address = ParseStoreAddress(options.address);
  if (!address.ok()) return Annotate(address.status(), kAddressFlag);
  if (address->kind != StoreAddress::Kind::kRedis) return std::nullopt;
  ASSIGN_OR_RETURN(auto redis, ReadRedisOptions(std::move(address->redis), options));
  return redis;
}

absl::StatusOr<OpenedStore> OpenStore(const StoreOptions& options, prometheus::Registry* registry,
                                      const JournalVisitor& visitor) {
  static const SteadyClock clock;
  auto address = ParseStoreAddress(options.address);
  if (!address.ok()) return Annotate(address.status(), kAddressFlag);
  if (address->kind == StoreAddress::Kind::kMemory) return OpenedStore();
  OpenedStore store = {.address = options.address};
  const auto replica = NewSessionId();  // any random name
  if (!replica.ok()) return replica.status();
  store.replica = *replica;
  std::unique_ptr<JournalBackend> backend;
  if (address->kind == StoreAddress::Kind::kFile) {
    auto opened =
        OpenFileBackend(address->folder, options.retention, absl::Now, /*clock=*/nullptr, visitor);
    if (!opened.ok()) return Annotate(opened.status(), kAddressFlag);
    backend = *std::move(opened);
  } else {
    ASSIGN_OR_RETURN(const auto redis, ReadRedisOptions(std::move(address->redis), options));
    const absl::Duration retention = std::min(options.retention, kLongestRetention);
    backend = NewRedisBackend(redis, retention, store.replica, options.may_evict);
    store.shared = std::make_unique<RedisShared>(redis, store.replica);
    store.heads = std::make_unique<HeadLogStore>(redis, retention, &clock, registry);
  }
  const absl::Duration check_interval =
      std::min(JournalStore::kCheckInterval, options.retention / 4);
  store.journals =
      std::make_unique<JournalStore>(std::move(backend), &clock, registry, check_interval);
  return store;
}

}  // namespace spikeserve
