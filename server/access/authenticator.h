// Finds the caller that a bearer token belongs to.
//
//   auto authenticator = Authenticator::Create("tokens.json");
//   auto caller = (*authenticator)->Authenticate(token);
//   if (caller.ok() && (*caller)->role() == Role::kOperator) ...
//
// Thread-safe. Authenticate takes no lock and allocates nothing: readers follow one pointer to an
// immutable table. When the file changes, the old table is kept, because pointers to its
// credentials stay in use; tables are small and files change rarely.
#ifndef SERVER_ACCESS_AUTHENTICATOR_H_
#define SERVER_ACCESS_AUTHENTICATOR_H_

#include <atomic>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/container/flat_hash_map.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "server/access/refusal_pacer.h"
#include "server/access/tenant.h"
#include "server/access/token_file.h"
#include "server/base/role.h"

namespace spikeserve {

// The tenant and the role of a token. Lives as long as the authenticator. Thread-safe.
class Credential {
 public:
  // REQUIRES: `tenant` is the tenant that `entry` names.
  Credential(std::shared_ptr<Tenant> tenant, TokenEntry entry)
      : tenant_(std::move(tenant)), entry_(std::move(entry)) {}

  const std::shared_ptr<Tenant>& tenant() const { return tenant_; }
  Role role() const { return entry_.role; }
  // Returns the name that the tokens file gives to the token; empty if it gives none.
  const std::string& name() const { return entry_.name; }

  // Returns true if this caller may read the sessions of `tenant`: list, get and explain them.
  bool CanRead(absl::string_view tenant) const {
    return entry_.sees_all || tenant == tenant_->name();
  }

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
  // Reads the tokens file at `path`. If `path` is empty, every caller is an operator of one tenant
  // that has an empty name and no limits. Errors name the file.
  static absl::StatusOr<std::unique_ptr<Authenticator>> Create(const std::string& path);

  // Returns the credential of `token`; an empty token means that the caller sent none. Returns
  // UNAUTHENTICATED if the token is missing, unknown, expired or revoked.
  absl::StatusOr<const Credential*> Authenticate(absl::string_view token) const;

  // Returns the pacer that delays refusals of `caller`: the pacer of its tenant, or, for a caller
  // that could not be authenticated, one pacer that all such callers share.
  RefusalPacer& RefusalPacerFor(const absl::StatusOr<const Credential*>& caller) const {
    return caller.ok() ? (*caller)->tenant()->refusals() : unauthenticated_;
  }

  // Reads the file again and applies it if its text has changed. On an error the tokens that were
  // read before stay valid.
  absl::Status Reload();

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

  explicit Authenticator(std::string path) : path_(std::move(path)) {}

  void Publish(const TokenFile& file) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  std::shared_ptr<Tenant> TenantOf(const std::string& name) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  const std::string path_;                 // empty: no tokens
  std::unique_ptr<Credential> anonymous_;  // every caller's; null if tokens are required
  std::atomic<const Table*> table_ = nullptr;
  mutable RefusalPacer unauthenticated_;

  absl::Mutex mutex_;  // taken by writers only
  std::string text_ ABSL_GUARDED_BY(mutex_);
  std::vector<std::unique_ptr<const Table>> tables_ ABSL_GUARDED_BY(mutex_);
  // By name. Tenants are never removed, so that sessions keep their tenant when the file changes.
  std::map<std::string, std::shared_ptr<Tenant>> tenants_ ABSL_GUARDED_BY(mutex_);
};

// Returns the token of an `authorization` header: TOKEN of "Bearer TOKEN", or the password of HTTP
// Basic authentication, which lets a browser show the status page. Returns an empty view if the
// header has neither. The result points into `authorization` or `buffer`.
absl::string_view ExtractToken(absl::string_view authorization, std::string* buffer);

}  // namespace spikeserve

#endif  // SERVER_ACCESS_AUTHENTICATOR_H_
