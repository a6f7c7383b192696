#include "server/store/open_store.h"

#include <utility>
#include <vector>

#include "absl/strings/ascii.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "absl/strings/strip.h"
#include "core/base/clock.h"
#include "core/base/file.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/session/session_store.h"
#include "server/store/file_backend.h"
#include "server/store/redis_backend.h"

namespace spikeserve {
namespace {

constexpr char kAddressFlag[] = "--session_store";
constexpr char kPasswordFlag[] = "--store_password_file";
constexpr int kLargestPort = 65535;

// Parses HOST[:PORT][/DATABASE]. Returns false if `text` is anything else.
bool ParseRedisAddress(absl::string_view text, RedisAddress* address) {
  const std::vector<absl::string_view> parts = absl::StrSplit(text, absl::MaxSplits('/', 1));
  if (parts.size() == 2 &&
      (!absl::SimpleAtoi(parts[1], &address->database) || address->database < 0)) {
    return false;
  }
  const std::vector<absl::string_view> host = absl::StrSplit(parts[0], absl::MaxSplits(':', 1));
  if (host.size() == 2 && (!absl::SimpleAtoi(host[1], &address->port) || address->port < 1 ||
                           address->port > kLargestPort)) {
    return false;
  }
  address->host = std::string(host[0]);
  return !address->host.empty();
}

absl::StatusOr<std::unique_ptr<JournalBackend>> OpenRedis(RedisAddress address,
                                                          const StoreOptions& options) {
  if (!options.password_file.empty()) {
    auto password = ReadFile(options.password_file);
    if (!password.ok()) return Annotate(password.status(), kPasswordFlag);
    address.password = std::string(absl::StripAsciiWhitespace(*password));
  }
  const auto owner = NewSessionId();  // any random name
  if (!owner.ok()) return owner.status();
  return NewRedisBackend(std::move(address), options.retention, *owner);
}

}  // namespace

absl::StatusOr<StoreAddress> ParseStoreAddress(const std::string& text) {
  if (text == "memory") return StoreAddress();
  absl::string_view rest = text;
  if (absl::ConsumePrefix(&rest, "file:") && !rest.empty()) {
    return StoreAddress{.kind = StoreAddress::Kind::kFile, .folder = std::string(rest)};
  }
  StoreAddress address = {.kind = StoreAddress::Kind::kRedis};
  rest = text;
  if (absl::ConsumePrefix(&rest, "redis://") && ParseRedisAddress(rest, &address.redis)) {
    return address;
  }
  return absl::InvalidArgumentError(absl::StrCat(
      "expected memory, file:DIR or redis://HOST[:PORT][/DATABASE], received ", Quoted(text)));
}

absl::Status StoreOptions::Validate() const {
  const auto parsed = ParseStoreAddress(address);
  if (!parsed.ok()) return Annotate(parsed.status(), kAddressFlag);
  if (!password_file.empty() && parsed->kind != StoreAddress::Kind::kRedis) {
    return absl::InvalidArgumentError(absl::StrCat(
        kPasswordFlag, ": expected none without a store in Redis, received ", password_file));
  }
  return absl::OkStatus();
}

absl::StatusOr<std::unique_ptr<JournalStore>> OpenStore(const StoreOptions& options,
                                                        prometheus::Registry* registry) {
  static const SteadyClock clock;
  const auto address = ParseStoreAddress(options.address);
  if (!address.ok()) return Annotate(address.status(), kAddressFlag);
  if (address->kind == StoreAddress::Kind::kMemory) return nullptr;
  auto backend = address->kind == StoreAddress::Kind::kFile
                     ? OpenFileBackend(address->folder, options.retention)
                     : OpenRedis(address->redis, options);
  if (!backend.ok()) return Annotate(backend.status(), kAddressFlag);
  return std::make_unique<JournalStore>(*std::move(backend), &clock, registry);
}

}  // namespace spikeserve
