#include "core/datagram/sealed_channel.h"

#include <openssl/core_names.h>
#include <openssl/crypto.h>
#include <openssl/evp.h>
#include <openssl/kdf.h>
#include <openssl/params.h>
#include <openssl/rand.h>

#include <algorithm>
#include <array>
#include <utility>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

constexpr char kVersion = 1;
constexpr size_t kNonceBytes = 12;

uint64_t Load(const char* bytes) {
  uint64_t number = 0;
  for (int i = 0; i < 8; ++i) number = number << 8 | static_cast<unsigned char>(bytes[i]);
  return number;
}
void Store(uint64_t number, char* bytes) {
  for (int i = 8; i-- > 0; number >>= 8) bytes[i] = static_cast<char>(number & 0xff);
}

const unsigned char* BytesOf(absl::string_view text) {
  return reinterpret_cast<const unsigned char*>(text.data());
}
unsigned char* BytesOf(char* text) { return reinterpret_cast<unsigned char*>(text); }

absl::Status OpenSslFailed(absl::string_view what) {
  return absl::InternalError(absl::StrCat("datagrams: OpenSSL failed: ", what));
}

// The key of one direction.
struct DirectionKey {
  ~DirectionKey() { OPENSSL_cleanse(bytes.data(), bytes.size()); }
  std::array<unsigned char, kDatagramKeyBytes> bytes = {};
};

bool Derive(absl::string_view key, absl::string_view direction, DirectionKey* derived) {
  EVP_KDF* const kdf = EVP_KDF_fetch(nullptr, "HKDF", nullptr);
  EVP_KDF_CTX* const context = EVP_KDF_CTX_new(kdf);
  EVP_KDF_free(kdf);
  std::string info = absl::StrCat("spikeserve datagram 1 ", direction);
  std::string secret(key);
  char digest[] = "SHA256";
  const OSSL_PARAM parameters[] = {
      OSSL_PARAM_construct_utf8_string(OSSL_KDF_PARAM_DIGEST, digest, 0),
      OSSL_PARAM_construct_octet_string(OSSL_KDF_PARAM_KEY, secret.data(), secret.size()),
      OSSL_PARAM_construct_octet_string(OSSL_KDF_PARAM_INFO, info.data(), info.size()),
      OSSL_PARAM_construct_end()};
  const bool is_derived =
      context != nullptr &&
      EVP_KDF_derive(context, derived->bytes.data(), derived->bytes.size(), parameters) == 1;
  EVP_KDF_CTX_free(context);
  OPENSSL_cleanse(secret.data(), secret.size());
  return is_derived;
}

std::array<unsigned char, kNonceBytes> NonceOf(const char* counter) {
  std::array<unsigned char, kNonceBytes> nonce = {};
  std::copy(counter, counter + 8, nonce.begin() + 4);
  return nonce;
}

}  // namespace

bool ReplayWindow::IsNew(uint64_t number) const {
  if (number >= past_) return true;
  if (past_ - 1 - number >= kSize) return false;
  return (seen_[number / kBits % kWords] >> (number % kBits) & 1U) == 0;
}

bool ReplayWindow::Add(uint64_t number) {
  const bool is_newest = number >= past_;
  if (is_newest) {
    // The words between the newest one and that of `number` are of numbers that did not arrive.
    const uint64_t newest_word = past_ == 0 ? 0 : (past_ - 1) / kBits;
    const uint64_t steps = std::min(number / kBits - newest_word, kWords);
    for (uint64_t i = 0; i < steps; ++i) seen_[(number / kBits - i) % kWords] = 0;
    past_ = number + 1;
  }
  seen_[number / kBits % kWords] |= uint64_t{1} << (number % kBits);
  return is_newest;
}

std::optional<uint64_t> KeyIdOf(absl::string_view datagram) {
  if (datagram.size() < kDatagramHeadBytes + kDatagramTagBytes ||
      datagram.size() > kDatagramBytes || datagram.front() != kVersion) {
    return std::nullopt;
  }
  return Load(datagram.data() + 1);
}

absl::StatusOr<std::string> DrawKeyBytes(size_t size) {
  std::string bytes(size, '\0');
  if (RAND_bytes(BytesOf(bytes.data()), static_cast<int>(size)) == 1) return bytes;
  return OpenSslFailed("no random bytes");
}

void SealedChannel::FreeCipher::operator()(evp_cipher_ctx_st* cipher) const {
  EVP_CIPHER_CTX_free(cipher);
}

SealedChannel::~SealedChannel() = default;

SealedChannel::Cipher SealedChannel::MakeCipher(absl::string_view key, absl::string_view direction,
                                                bool seals) {
  DirectionKey derived;
  Cipher cipher(EVP_CIPHER_CTX_new());
  const bool is_made = Derive(key, direction, &derived) && cipher != nullptr &&
                       EVP_CipherInit_ex(cipher.get(), EVP_chacha20_poly1305(), nullptr,
                                         derived.bytes.data(), nullptr, seals ? 1 : 0) == 1;
  return is_made ? std::move(cipher) : nullptr;
}

absl::StatusOr<std::unique_ptr<SealedChannel>> SealedChannel::Create(uint64_t key_id,
                                                                     absl::string_view key,
                                                                     End end) {
  if (key.size() != kDatagramKeyBytes) {
    return absl::InvalidArgumentError(absl::StrCat("datagrams.key: expected ", kDatagramKeyBytes,
                                                   " bytes, received ", key.size()));
  }
  auto channel = std::unique_ptr<SealedChannel>(new SealedChannel(key_id));
  const bool is_robot = end == End::kRobot;
  channel->seal_ = MakeCipher(key, is_robot ? "robot" : "server", /*seals=*/true);
  channel->open_ = MakeCipher(key, is_robot ? "server" : "robot", /*seals=*/false);
  if (channel->seal_ == nullptr || channel->open_ == nullptr) return OpenSslFailed("no cipher");
  return channel;
}

bool SealedChannel::Seal(absl::string_view payload, std::string* datagram) {
  if (payload.size() > kDatagramPayloadBytes || sealed_ >= kMostDatagrams) return false;
  datagram->resize(kDatagramHeadBytes + payload.size() + kDatagramTagBytes);
  char* const head = datagram->data();
  head[0] = kVersion;
  Store(key_id_, head + 1);
  Store(sealed_++, head + 9);
  const auto nonce = NonceOf(head + 9);
  unsigned char* const sealed = BytesOf(head + kDatagramHeadBytes);
  EVP_CIPHER_CTX* const cipher = seal_.get();
  int size = 0;
  return EVP_EncryptInit_ex(cipher, nullptr, nullptr, nullptr, nonce.data()) == 1 &&
         EVP_EncryptUpdate(cipher, nullptr, &size, BytesOf(head), kDatagramHeadBytes) == 1 &&
         EVP_EncryptUpdate(cipher, sealed, &size, BytesOf(payload),
                           static_cast<int>(payload.size())) == 1 &&
         EVP_EncryptFinal_ex(cipher, sealed + payload.size(), &size) == 1 &&
         EVP_CIPHER_CTX_ctrl(cipher, EVP_CTRL_AEAD_GET_TAG, kDatagramTagBytes,
                             sealed + payload.size()) == 1;
}

Opened SealedChannel::Open(absl::string_view datagram, std::string* payload, bool* is_newest) {
  if (KeyIdOf(datagram) != key_id_) return Opened::kMalformed;
  const uint64_t counter = Load(datagram.data() + 9);
  if (counter >= kMostDatagrams) return Opened::kMalformed;
  if (!arrived_.IsNew(counter)) return Opened::kReplayed;
  const auto nonce = NonceOf(datagram.data() + 9);
  const size_t length = datagram.size() - kDatagramHeadBytes - kDatagramTagBytes;
  const absl::string_view sealed = datagram.substr(kDatagramHeadBytes, length);
  std::string tag(datagram.substr(kDatagramHeadBytes + length));
  payload->resize(length);
  EVP_CIPHER_CTX* const cipher = open_.get();
  int size = 0;
  const bool is_authentic =
      EVP_DecryptInit_ex(cipher, nullptr, nullptr, nullptr, nonce.data()) == 1 &&
      EVP_CIPHER_CTX_ctrl(cipher, EVP_CTRL_AEAD_SET_TAG, kDatagramTagBytes, tag.data()) == 1 &&
      EVP_DecryptUpdate(cipher, nullptr, &size, BytesOf(datagram), kDatagramHeadBytes) == 1 &&
      EVP_DecryptUpdate(cipher, BytesOf(payload->data()), &size, BytesOf(sealed),
                        static_cast<int>(length)) == 1 &&
      EVP_DecryptFinal_ex(cipher, BytesOf(payload->data()) + length, &size) == 1;
  if (!is_authentic) {
    payload->clear();
    return Opened::kForged;
  }
  *is_newest = arrived_.Add(counter);
  return Opened::kOk;
}

}  // namespace spikeserve
