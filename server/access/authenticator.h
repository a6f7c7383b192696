// Who makes a call.
//
// Thread-safe. Looking a token up takes no lock and allocates nothing: readers follow one pointer
// to an immutable table. Tables that a changed file replaced are kept, so that what was handed out
// stays valid; they are small and files change rarely.
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

// Whose a token is and what it allows; lives as long as the authenticator.
class Credential {
 public:
  // `tenant` is the one that `entry` names.
  Credential(std::shared_ptr<Tenant> tenant, TokenEntry entry)
      : tenant_(std::move(tenant)), entry_(std::move(entry)) {}

  const std::shared_ptr<Tenant>& tenant() const { return tenant_; }
  Role role() const { return entry_.role; }

  // Whether sessions of this tenant may be looked at: listed, shown, explained.
  bool MaySee(absl::string_view tenant) const {
    return entry_.sees_all || tenant == tenant_->name();
  }

  // UNAUTHENTICATED once it has expired or the file has it no more.
  absl::Status CheckValid() const;

 private:
  friend class Authenticator;

  const std::shared_ptr<Tenant> tenant_;
  const TokenEntry entry_;
  std::atomic<bool> revoked_ = false;
};

class Authenticator {
 public:
  // Without a file everybody is an operator of one tenant without name or limits. Errors of reading
  // or parsing the file name it.
  static absl::StatusOr<std::unique_ptr<Authenticator>> Create(const std::string& path);

  // The holder of `token`, which is empty where none came. UNAUTHENTICATED for a token that is
  // missing, unknown or expired.
  absl::StatusOr<const Credential*> Authenticate(absl::string_view token) const;

  // Of the caller that Authenticate, or a check after it, let in or refused: its tenant's, or that
  // of all who were not let in.
  RefusalPacer& RefusalsOf(const absl::StatusOr<const Credential*>& caller) const {
    return caller.ok() ? (*caller)->tenant()->refusals() : strangers_;
  }

  // Reads the file again if it changed. On an error what was read before stays in force.
  absl::Status Reload();

 private:
  // Looked up by a hash that an attacker cannot aim at bytes of, and compared in constant time.
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
  std::unique_ptr<Credential> everybody_;  // null where tokens are asked for
  std::atomic<const Table*> table_ = nullptr;
  mutable RefusalPacer strangers_;

  absl::Mutex mutex_;  // for changes
  std::string text_ ABSL_GUARDED_BY(mutex_);
  std::vector<std::unique_ptr<const Table>> tables_ ABSL_GUARDED_BY(mutex_);
  // By name, and never dropped: a tenant keeps its sessions over a change of the file.
  std::map<std::string, std::shared_ptr<Tenant>> tenants_ ABSL_GUARDED_BY(mutex_);
};

// The token of "Bearer TOKEN", or the password of HTTP's "Basic", so that a browser can show the
// status page; empty where there is none.
absl::string_view TokenOf(absl::string_view authorization, std::string* buffer);

}  // namespace spikeserve

#endif  // SERVER_ACCESS_AUTHENTICATOR_H_
