#include "core/digest/sha256.h"

#include <openssl/evp.h>

#include <memory>

#include "absl/strings/escaping.h"

namespace spikeserve {

std::array<uint8_t, 32> Sha256BytesOf(absl::string_view bytes) {
  // Fetching the algorithm, as SHA256() does, takes a global lock of OpenSSL, so it is fetched
  // once, and each thread reuses one context.
  static const EVP_MD* const kSha256 = EVP_MD_fetch(nullptr, "SHA256", nullptr);
  struct Free {
    void operator()(EVP_MD_CTX* context) const { EVP_MD_CTX_free(context); }
  };
  thread_local const std::unique_ptr<EVP_MD_CTX, Free> context(EVP_MD_CTX_new());
  std::array<uint8_t, 32> digest = {};
  EVP_DigestInit_ex(context.get(), kSha256, nullptr);
  EVP_DigestUpdate(context.get(), bytes.data(), bytes.size());
  EVP_DigestFinal_ex(context.get(), digest.data(), nullptr);
  return digest;
}

std::string Sha256Of(absl::string_view bytes) {
  const std::array<uint8_t, 32> digest = Sha256BytesOf(bytes);
  return absl::BytesToHexString({reinterpret_cast<const char*>(digest.data()), digest.size()});
}

}  // namespace spikeserve
