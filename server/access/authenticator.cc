#include "server/access/authenticator.h"

#include <openssl/crypto.h>

#include <cstring>
#include <utility>

#include "absl/strings/escaping.h"
#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/time/clock.h"
#include "core/base/file.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"

namespace spikeserve {
absl::Status Credential::CheckValid() const {
  if (revoked_.load(std::memory_order_relaxed)) {
    return absl::UnauthenticatedError("authorization: the token was revoked");
  }
  if (entry_.expires != absl::InfiniteFuture() && absl::Now() >= entry_.expires) {
    return absl::UnauthenticatedError("authorization: the token has expired");
  }
  return absl::OkStatus();
}

size_t Authenticator::DigestHash::operator()(const Digest& digest) const {
  size_t hash;  // the bits of a SHA-256 digest are uniform, so its first bytes serve as the hash
  std::memcpy(&hash, digest.data(), sizeof(hash));
  return hash;
}

bool Authenticator::DigestEqual::operator()(const Digest& a, const Digest& b) const {
  return CRYPTO_memcmp(a.data(), b.data(), a.size()) == 0;
}

absl::StatusOr<std::unique_ptr<Authenticator>> Authenticator::Create(const std::string& path,
                                                                     int64_t default_sessions) {
  auto authenticator = std::unique_ptr<Authenticator>(new Authenticator(path, default_sessions));
  if (path.empty()) {
    authenticator->anonymous_ = std::make_shared<const Credential>(
        std::make_shared<Tenant>(""), TokenEntry{.role = Role::kOperator});
    return authenticator;
  }
  RETURN_IF_ERROR(authenticator->Reload());
  return authenticator;
}

absl::StatusOr<std::shared_ptr<const Credential>> Authenticator::Authenticate(
    absl::string_view token) const {
  if (anonymous_ != nullptr) return anonymous_;
  if (token.empty()) {
    return absl::UnauthenticatedError("authorization: expected \"Bearer TOKEN\", received none");
  }
  const Digest digest = Sha256(token);
  std::shared_ptr<const Credential> credential;
  {
    absl::ReaderMutexLock lock(&table_mutex_);
    if (const auto found = table_.find(digest); found != table_.end()) credential = found->second;
  }
  if (credential == nullptr) {
    return absl::UnauthenticatedError(
        "authorization: expected a token of the tokens file, received an unknown one");
  }
  RETURN_IF_ERROR(credential->CheckValid());
  return credential;
}

std::vector<std::shared_ptr<Tenant>> Authenticator::Tenants() const {
  if (anonymous_ != nullptr) return {anonymous_->tenant()};
  std::vector<std::shared_ptr<Tenant>> tenants;
  absl::MutexLock lock(&mutex_);
  for (const auto& [name, tenant] : tenants_) tenants.push_back(tenant);
  return tenants;
}

absl::Status Authenticator::Reload() {
  if (path_.empty()) return absl::OkStatus();
  auto text = ReadFile(path_);
  if (!text.ok()) return Annotate(text.status(), "--tokens");
  absl::MutexLock lock(&mutex_);
  if (text_ == *text) return absl::OkStatus();
  const auto file = ParseTokenFile(*text);
  if (!file.ok()) {
    return Annotate(file.status(), absl::StrCat("--tokens: ", path_));
  }
  text_ = *std::move(text);
  Publish(*file);
  return absl::OkStatus();
}

void Authenticator::SetReplicas(int replicas) {
  absl::MutexLock lock(&mutex_);
  if (std::exchange(replicas_, replicas) == replicas || !text_.has_value()) return;
  const auto file = ParseTokenFile(*text_);
  if (file.ok()) Publish(*file);
}

std::shared_ptr<Tenant> Authenticator::TenantOf(const std::string& name) {
  std::shared_ptr<Tenant>& tenant = tenants_[name];
  if (tenant == nullptr) tenant = std::make_shared<Tenant>(name);
  return tenant;
}

void Authenticator::Publish(const TokenFile& file) {
  const int64_t share = file.tenants.size() > 1 ? default_sessions_ : 0;
  for (const auto& [name, limits] : file.tenants) {
    TenantLimits divided = limits;
    divided.decisions_per_second /= replicas_;
    CallRates& calls = divided.calls_per_second;
    for (double* rate : {&calls.light, &calls.listing, &calls.explain, &calls.operators}) {
      *rate /= replicas_;
    }
    TenantOf(name)->SetLimits(divided, share);
  }
  Table table;
  {
    absl::ReaderMutexLock lock(&table_mutex_);
    for (const TokenEntry& entry : file.tokens) {
      const auto known = table_.find(entry.sha256);
      const bool unchanged = known != table_.end() && known->second->entry_ == entry;
      table.emplace(
          entry.sha256,
          unchanged ? known->second : std::make_shared<Credential>(TenantOf(entry.tenant), entry));
    }
    for (const auto& [digest, credential] : table_) {
      const auto kept = table.find(digest);
      const bool same = kept != table.end() && kept->second == credential;
      if (!same) credential->revoked_.store(true, std::memory_order_relaxed);
    }
  }
  {
    absl::MutexLock lock(&table_mutex_);
    table_.swap(table);
  }
  table.clear();
  // References are added under the mutex only, so a count of one is the map's own and stays one.
  std::erase_if(tenants_, [&](const auto& item) {
    return item.second.use_count() == 1 && !file.tenants.contains(item.first);
  });
}

absl::string_view ExtractToken(absl::string_view authorization, std::string* buffer) {
  constexpr absl::string_view kBearer = "Bearer ";
  constexpr absl::string_view kBasic = "Basic ";
  if (absl::StartsWithIgnoreCase(authorization, kBearer)) {
    authorization.remove_prefix(kBearer.size());
    return {authorization.data(), authorization.size()};
  }
  if (!absl::StartsWithIgnoreCase(authorization, kBasic)) return {};
  if (!absl::Base64Unescape(authorization.substr(kBasic.size()), buffer)) return {};
  const size_t colon = buffer->find(':');
  return colon == std::string::npos ? absl::string_view()
                                    : absl::string_view(*buffer).substr(colon + 1);
}

}  // namespace spikeserve
