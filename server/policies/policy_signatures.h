// Signs policy files, and verifies their signatures, so that a server serves only the policies of
// people whom its operator trusts.
//
// A signature is the 64 bytes of Ed25519 (RFC 8032) for the content of a policy file, or for its
// statement (StatementOf), which also names the policy and the version. It lies in a file beside
// the policy file, whose name ends in ".sig", as OpenSSL writes it:
//
//   openssl pkeyutl -sign -rawin -inkey private.pem -in policy.safetensors -out
//     policy.safetensors.sig
//
// Or it is a bundle of model signing, by a key on a curve of NIST: of the file, or of the policy
// directory, which also names the policy and the version.
//
// Immutable and thread-safe.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"

struct evp_pkey_st;

namespace spikeserve {

inline constexpr size_t kSignatureBytes = 64;

// The files of a version.
struct VersionFiles {
  std::string policy;     // the content of policy.safetensors
  std::string signature;  // of `policy` or its statement; empty: the version is not signed
  bool pushed = false;    // see policy_folder.h
};

// What a signature is for.
struct SignedVersion {
  std::string policy;  // name
  int64_t version = 0;
  std::string sha256;              // of the content
  absl::string_view content = {};  // empty: the signature has to name the policy and the version
};

// Returns the text whose signature holds for one version of one policy alone.
std::string StatementOf(const SignedVersion& signed_version);

class PolicySignatures {
 public:
  // Reads the file `trusted_keys`, which holds one or more public keys in PEM, Ed25519 or on the
  // curves P-256, P-384 and P-521, and, unless its path is empty, the file `signing_key`, which
  // holds the private key of an Ed25519 key of them. Returns INVALID_ARGUMENT, which names the flag
  // and the file, for anything else.
  static absl::StatusOr<std::shared_ptr<const PolicySignatures>> Read(
      const std::string& trusted_keys, const std::string& signing_key);

  // Returns INVALID_ARGUMENT unless one of the trusted keys has made `signature` of the version.
  absl::Status Verify(absl::string_view signature, const SignedVersion& signed_version) const;

  // Returns FAILED_PRECONDITION without a signing key.
  absl::Status CheckCanSign() const;

  // Returns the signature of the content of a policy file, or the error of CheckCanSign().
  absl::StatusOr<std::string> Sign(absl::string_view policy) const;

 private:
  using Key = std::shared_ptr<evp_pkey_st>;

  absl::Status VerifyBundle(absl::string_view bytes, const SignedVersion& signed_version) const;

  PolicySignatures(std::vector<Key> trusted, Key signing)
      : trusted_(std::move(trusted)), signing_(std::move(signing)) {}

  const std::vector<Key> trusted_;
  const Key signing_;  // null: none
};

// Returns the path of the signature of a policy file.
std::string SignaturePath(const std::string& policy_path);

// Reads a policy file once, and its signature `with_signature`, which is empty if there is none and
// not verified. Returns NOT_FOUND if there is no policy file, and INVALID_ARGUMENT if a file cannot
// be read; messages start with the path.
absl::StatusOr<VersionFiles> ReadVersionFiles(const std::string& policy_path, bool with_signature);

}  // namespace spikeserve
