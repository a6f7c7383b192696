// Finds the caller that a bearer token belongs to.
//
//   auto authenticator = Authenticator::Create("tokens.json");
//   auto caller = (*authenticator)->Authenticate(token);
//   if (caller.ok() && (*caller)->role() == Role::kOperator) ...
//
// Thread-safe. Authenticate allocates nothing, and many threads may call it at the same time. When
// the file changes, credentials that were removed live on until no call holds them.
#pragma once

#include <atomic>
#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/container/flat_hash_map.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "server/access/refusal_pacer.h"
#include "server/access/role.h"
#include "server/access/tenant.h"
#include "server/access/token_file.h"

namespace spikeserve {

// The tenant and the role of a token. Thread-safe.
class Credential : public std::enable_shared_from_this<Credential> {
 public:
  // REQUIRES: `tenant` is the tenant that `entry` names.
  Credential(std::shared_ptr<Tenant> tenant, TokenEntry entry)
      : tenant_(std::move(tenant)), entry_(std::move(entry)) {}

  const std::shared_ptr<Tenant>& tenant() const { return tenant_; }
  Role role() const { return entry_.role; }
  // Returns the name that the tokens file gives to the token; empty if it gives none.
  const std::string& name() const { return entry_.name; }
  // Returns true if this caller may open sessions that learn.
  bool may_learn() const { return entry_.may_learn; }

  // Returns true if this caller may read the sessions of `tenant`: list, get and explain them.
  bool CanRead(absl::string_view tenant) const {
    return entry_.sees_all || tenant == tenant_->name();
  }

  // Returns true if this caller may read what belongs to any tenant, or there are none.
  bool CanReadAll() const { return entry_.sees_all || tenant_->name().empty(); }

  // Returns UNAUTHENTICATED if the token has expired or was removed from the file.
  absl::Status CheckValid() const;

 private:
  friend class Authenticator;

  const std::shared_ptr<Tenant> tenant_;
  const TokenEntry entry_;
  std::atomic<bool> revoked_ = false;
};

class Authenticator {
 public:
  // Reads the tokens file at `path`. `default_sessions` are the open sessions of a tenant without
  // max_sessions, if the file has several tenants; 0 is no limit. If `path` is empty, every caller
  // is an operator of one tenant that has an empty name and no limits. Errors name the file.
  static absl::StatusOr<std::unique_ptr<Authenticator>> Create(const std::string& path,
                                                               int64_t default_sessions = 0);

  // Returns the credential of `token`; an empty token means that the caller sent none. Returns
  // UNAUTHENTICATED if the token is missing, unknown, expired or revoked.
  absl::StatusOr<std::shared_ptr<const Credential>> Authenticate(absl::string_view token) const
      ABSL_LOCKS_EXCLUDED(table_mutex_);

  // Returns the pacer that delays refusals of `caller`: the pacer of its tenant, or, for a caller
  // that could not be authenticated, one pacer that all such callers share.
  RefusalPacer& RefusalPacerFor(
      const absl::StatusOr<std::shared_ptr<const Credential>>& caller) const {
    return caller.ok() ? (*caller)->tenant()->refusals() : unauthenticated_;
  }

  // Returns the tenants of the file, and those that still have sessions; without a file, the one
  // that has an empty name.
  std::vector<std::shared_ptr<Tenant>> Tenants() const ABSL_LOCKS_EXCLUDED(mutex_);

  // Reads the file again and applies it if its text has changed. On an error the tokens that were
  // read before stay valid.
  absl::Status Reload();

  // Gives this server its share of the decisions per second of each tenant: one of `replicas` equal
  // ones.
  void SetReplicas(int replicas) ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  // Tokens are looked up by their SHA-256 digest, whose bytes an attacker cannot choose, and
  // digests are compared in constant time, so timing reveals nothing about stored tokens.
  struct DigestHash {
    size_t operator()(const Digest& digest) const;
  };
  struct DigestEqual {
    bool operator()(const Digest& a, const Digest& b) const;
  };
  using Table = absl::flat_hash_map<Digest, std::shared_ptr<Credential>, DigestHash, DigestEqual>;

  Authenticator(std::string path, int64_t default_sessions)
      : path_(std::move(path)), default_sessions_(default_sessions) {}

  void Publish(const TokenFile& file) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_)
      ABSL_LOCKS_EXCLUDED(table_mutex_);
  std::shared_ptr<Tenant> TenantOf(const std::string& name) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  const std::string path_;  // empty: no tokens
  const int64_t default_sessions_;
  std::shared_ptr<const Credential> anonymous_;  // every caller's; null if tokens are required
  mutable RefusalPacer unauthenticated_;

  mutable absl::Mutex mutex_;                                // taken by writers only
  std::optional<std::string> text_ ABSL_GUARDED_BY(mutex_);  // of the file that was applied
  int replicas_ ABSL_GUARDED_BY(mutex_) = 1;
  // By name. A tenant that was removed from the file is kept while sessions or calls belong to it.
  std::map<std::string, std::shared_ptr<Tenant>> tenants_ ABSL_GUARDED_BY(mutex_);

  mutable absl::Mutex table_mutex_ ABSL_ACQUIRED_AFTER(mutex_);  // shared by readers
  Table table_ ABSL_GUARDED_BY(table_mutex_);
};

// Returns the token of an `authorization` header: TOKEN of "Bearer TOKEN", or the password of HTTP
// Basic authentication, which lets a browser show the status page. Returns an empty view if the
// header has neither. The result points into `authorization` or `buffer`.
absl::string_view ExtractToken(absl::string_view authorization, std::string* buffer);

}  // namespace spikeserve
