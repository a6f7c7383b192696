#include "server/policies/policy_signatures.h"

#include <fcntl.h>
#include <openssl/bio.h>
#include <openssl/err.h>
#include <openssl/evp.h>
#include <openssl/pem.h>
#include <openssl/x509.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>

#include "absl/strings/str_cat.h"
#include "core/base/file.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/model/safetensors.h"
#include "server/policies/signature_bundle.h"

namespace spikeserve {
namespace {

using Key = std::shared_ptr<evp_pkey_st>;

const unsigned char* Data(absl::string_view bytes) {
  return reinterpret_cast<const unsigned char*>(bytes.data());
}

absl::Status KeyError(absl::string_view expected, absl::string_view received) {
  return absl::InvalidArgumentError(absl::StrCat("expected ", expected, ", received ", received));
}

// One block of a PEM file, such as PUBLIC KEY.
struct PemBlock {
  std::string name;
  std::string der;
};

// Returns all blocks, also those of kinds that are not expected, so that none is ignored silently.
absl::StatusOr<std::vector<PemBlock>> ParsePem(absl::string_view text) {
  const std::unique_ptr<BIO, decltype(&BIO_free)> bio(
      BIO_new_mem_buf(text.data(), static_cast<int>(text.size())), &BIO_free);
  std::vector<PemBlock> blocks;
  char* name = nullptr;
  char* header = nullptr;
  unsigned char* der = nullptr;
  long length = 0;
  while (PEM_read_bio(bio.get(), &name, &header, &der, &length) == 1) {
    blocks.push_back({name, std::string(reinterpret_cast<const char*>(der), length)});
    OPENSSL_free(name);
    OPENSSL_free(header);
    OPENSSL_cleanse(der, length);
    OPENSSL_free(der);
  }
  const bool at_end = ERR_GET_REASON(ERR_peek_last_error()) == PEM_R_NO_START_LINE;
  ERR_clear_error();
  if (!at_end) return KeyError("PEM", "a block that cannot be read");
  return blocks;
}

bool IsEd25519(const Key& key) { return EVP_PKEY_get_id(key.get()) == EVP_PKEY_ED25519; }

// Returns the digest that model signing uses with a key on a curve; null: it does not use the
// curve.
const EVP_MD* DigestOf(const Key& key) {
  char curve[64] = {};
  EVP_PKEY_get_group_name(key.get(), curve, sizeof(curve), nullptr);
  const absl::string_view name = curve;
  if (name == SN_X9_62_prime256v1) return EVP_sha256();
  if (name == SN_secp384r1) return EVP_sha384();
  return name == SN_secp521r1 ? EVP_sha512() : nullptr;
}

absl::Status CheckKey(const Key& key, bool may_be_on_curve) {
  ERR_clear_error();
  if (key == nullptr) return KeyError("an Ed25519 key", "a block that is no key");
  if (IsEd25519(key) || (may_be_on_curve && DigestOf(key) != nullptr)) return absl::OkStatus();
  const char* const type = EVP_PKEY_get0_type_name(key.get());
  return KeyError("an Ed25519 key", absl::StrCat("a key of type ", type == nullptr ? "?" : type));
}

absl::StatusOr<std::vector<Key>> ReadPublicKeys(const std::string& path) {
  const auto text = ReadFile(path);
  if (!text.ok()) return absl::InvalidArgumentError(text.status().message());
  const auto blocks = ParsePem(*text);
  if (!blocks.ok()) return Annotate(blocks.status(), path);
  std::vector<Key> keys;
  for (const PemBlock& block : *blocks) {
    if (block.name != PEM_STRING_PUBLIC) {
      return Annotate(KeyError("only blocks PUBLIC KEY", absl::StrCat("a block ", block.name)),
                      path);
    }
    const unsigned char* der = Data(block.der);
    const Key key(d2i_PUBKEY(nullptr, &der, static_cast<long>(block.der.size())), &EVP_PKEY_free);
    if (auto status = CheckKey(key, /*may_be_on_curve=*/true); !status.ok())
      return Annotate(status, path);
    keys.push_back(key);
  }
  if (keys.empty()) return Annotate(KeyError("Ed25519 public keys in PEM", "none"), path);
  return keys;
}

absl::StatusOr<Key> ReadPrivateKey(const std::string& path) {
  const auto text = ReadFile(path);
  if (!text.ok()) return absl::InvalidArgumentError(text.status().message());
  const auto blocks = ParsePem(*text);
  if (!blocks.ok()) return Annotate(blocks.status(), path);
  if (blocks->size() != 1 || blocks->front().name != PEM_STRING_PKCS8INF) {
    return Annotate(
        KeyError("one block PRIVATE KEY, without a password",
                 blocks->empty() ? "none" : absl::StrCat("a block ", blocks->back().name)),
        path);
  }
  const std::string& bytes = blocks->front().der;
  const unsigned char* der = Data(bytes);
  const Key key(d2i_AutoPrivateKey(nullptr, &der, static_cast<long>(bytes.size())), &EVP_PKEY_free);
  if (auto status = CheckKey(key, /*may_be_on_curve=*/false); !status.ok())
    return Annotate(status, path);
  return key;
}

bool IsSignedBy(const Key& key, absl::string_view signature, absl::string_view text) {
  const std::unique_ptr<EVP_MD_CTX, decltype(&EVP_MD_CTX_free)> context(EVP_MD_CTX_new(),
                                                                        &EVP_MD_CTX_free);
  const bool valid =
      EVP_DigestVerifyInit(context.get(), nullptr, IsEd25519(key) ? nullptr : DigestOf(key),
                           nullptr, key.get()) == 1 &&
      EVP_DigestVerify(context.get(), Data(signature), signature.size(), Data(text), text.size()) ==
          1;
  ERR_clear_error();
  return valid;
}

// Returns the content of a signature file, without its bytes after the first one too many. Does not
// wait for the other end of a pipe. Returns an empty string if there is no such file.
absl::StatusOr<std::string> ReadSignature(const std::string& path) {
  const int fd = open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NONBLOCK);
  if (fd < 0 && errno == ENOENT) return std::string();
  if (fd < 0) return absl::InvalidArgumentError(absl::StrCat(path, ": ", std::strerror(errno)));
  struct stat file = {};
  std::string bytes(kMostBundleBytes + 1, '\0');
  const bool is_file = fstat(fd, &file) == 0 && S_ISREG(file.st_mode);
  const ssize_t length = is_file ? read(fd, bytes.data(), bytes.size()) : -1;
  close(fd);
  if (length < 0) {
    return absl::InvalidArgumentError(
        absl::StrCat(path, ": expected a file that can be read, received something else"));
  }
  bytes.resize(static_cast<size_t>(length));
  return bytes;
}

}  // namespace

absl::StatusOr<std::shared_ptr<const PolicySignatures>> PolicySignatures::Read(
    const std::string& trusted_keys, const std::string& signing_key) {
  auto trusted = ReadPublicKeys(trusted_keys);
  if (!trusted.ok()) return Annotate(trusted.status(), "--trusted_keys");
  Key signing;
  if (!signing_key.empty()) {
    auto key = ReadPrivateKey(signing_key);
    if (!key.ok()) return Annotate(key.status(), "--signing_key");
    signing = *std::move(key);
    const bool is_trusted = std::any_of(trusted->begin(), trusted->end(), [&](const Key& known) {
      return EVP_PKEY_eq(known.get(), signing.get()) == 1;
    });
    if (!is_trusted) {
      return absl::InvalidArgumentError(absl::StrCat(
          "--signing_key: ", signing_key, ": expected the private key of one of the keys in ",
          trusted_keys, ", received another key"));
    }
  }
  return std::shared_ptr<const PolicySignatures>(
      new PolicySignatures(*std::move(trusted), std::move(signing)));
}

absl::Status PolicySignatures::Verify(absl::string_view signature,
                                      const SignedVersion& signed_version) const {
  if (signature.empty()) {
    return absl::InvalidArgumentError(
        "expected a signature in policy.safetensors.sig, because of --trusted_keys, received none");
  }
  if (signature.size() > kSignatureBytes && signature.front() == '{') {
    return Annotate(VerifyBundle(signature, signed_version), "policy.safetensors.sig");
  }
  if (signature.size() != kSignatureBytes) {
    const std::string received =
        signature.size() > kSignatureBytes ? "more" : absl::StrCat(signature.size(), " bytes");
    return absl::InvalidArgumentError(
        absl::StrCat("policy.safetensors.sig: expected the ", kSignatureBytes,
                     " bytes of an Ed25519 signature, received ", received));
  }
  const std::string statement = StatementOf(signed_version);
  const bool valid = std::any_of(trusted_.begin(), trusted_.end(), [&](const Key& key) {
    if (!IsEd25519(key)) return false;
    return IsSignedBy(key, signature, statement) ||
           (!signed_version.content.empty() && IsSignedBy(key, signature, signed_version.content));
  });
  if (valid) return absl::OkStatus();
  return absl::InvalidArgumentError(absl::StrCat(
      "policy.safetensors.sig: expected the signature of this policy file by one of the ",
      trusted_.size(), " keys of --trusted_keys, received one of another file or key"));
}

absl::Status PolicySignatures::VerifyBundle(absl::string_view bytes,
                                            const SignedVersion& signed_version) const {
  if (bytes.size() > kMostBundleBytes) {
    return absl::InvalidArgumentError(
        absl::StrCat("expected at most ", kMostBundleBytes, " bytes, received more"));
  }
  ASSIGN_OR_RETURN(const SignatureBundle bundle, ParseBundle(bytes));
  const bool valid = std::any_of(trusted_.begin(), trusted_.end(), [&](const Key& key) {
    return IsSignedBy(key, bundle.signature, bundle.signed_text);
  });
  if (!valid) {
    return absl::InvalidArgumentError(absl::StrCat("expected a bundle by one of the ",
                                                   trusted_.size(),
                                                   " keys of --trusted_keys, received another"));
  }
  ASSIGN_OR_RETURN(const auto files, FilesOf(bundle));
  const std::string path =
      absl::StrCat(signed_version.policy, "/", signed_version.version, "/policy.safetensors");
  const bool is_signed = std::any_of(files.begin(), files.end(), [&](const auto& file) {
    const bool has_name = !signed_version.content.empty() &&
                          (file.first == "." || file.first == "policy.safetensors");
    return file.second == signed_version.sha256 && (has_name || file.first == path);
  });
  if (is_signed) return absl::OkStatus();
  return absl::InvalidArgumentError(absl::StrCat(
      "expected a bundle with SHA-256 ", signed_version.sha256, " of ", path,
      signed_version.content.empty() ? "" : " or of one file", ", received one of other files"));
}

absl::Status PolicySignatures::CheckCanSign() const {
  if (signing_ != nullptr) return absl::OkStatus();
  return absl::FailedPreconditionError(
      "--signing_key: expected the key that signs promoted versions, because --trusted_keys "
      "refuses versions without a signature, received none");
}

absl::StatusOr<std::string> PolicySignatures::Sign(absl::string_view policy) const {
  RETURN_IF_ERROR(CheckCanSign());
  const std::unique_ptr<EVP_MD_CTX, decltype(&EVP_MD_CTX_free)> context(EVP_MD_CTX_new(),
                                                                        &EVP_MD_CTX_free);
  std::string signature(kSignatureBytes, '\0');
  size_t length = signature.size();
  const bool signed_now =
      EVP_DigestSignInit(context.get(), nullptr, nullptr, nullptr, signing_.get()) == 1 &&
      EVP_DigestSign(context.get(), reinterpret_cast<unsigned char*>(signature.data()), &length,
                     Data(policy), policy.size()) == 1;
  ERR_clear_error();
  if (!signed_now || length != kSignatureBytes) {
    return absl::InternalError("--signing_key: OpenSSL cannot sign with this key");
  }
  return signature;
}

std::string SignaturePath(const std::string& policy_path) {
  return absl::StrCat(policy_path, ".sig");
}

std::string StatementOf(const SignedVersion& signed_version) {
  return absl::StrCat("spikeserve policy ", signed_version.policy, " ", signed_version.version, " ",
                      signed_version.sha256, "\n");
}

absl::StatusOr<VersionFiles> ReadVersionFiles(const std::string& policy_path, bool with_signature) {
  auto policy = ReadSafetensorsFile(policy_path);
  if (!policy.ok()) return Annotate(policy.status(), policy_path);
  VersionFiles files = {.policy = *std::move(policy), .signature = {}};
  if (!with_signature) return files;
  ASSIGN_OR_RETURN(files.signature, ReadSignature(SignaturePath(policy_path)));
  return files;
}

}  // namespace spikeserve
