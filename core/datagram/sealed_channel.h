// One end of a channel of datagrams, each of which is sealed with a key that both ends have.
//
//   auto robot = SealedChannel::Create(id, key, SealedChannel::End::kRobot);
//   robot->Seal(payload, &datagram);                     // false: the channel is used up
//   if (server->Open(datagram, &payload, &is_newest) == Opened::kOk) ...
//
// A datagram is `version (1) | key id (8) | counter (8) | sealed payload | tag (16)`, numbers in
// big-endian order. ChaCha20-Poly1305 (RFC 8439) seals it, with the counter as nonce and the first
// 17 bytes as additional data. Each direction has a key of its own, derived from the given one by
// HKDF-SHA256 (RFC 5869). docs/design/datagrams.md has the reasons.
//
// Not thread-safe.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"

struct evp_cipher_ctx_st;

namespace spikeserve {

// The most bytes of a datagram: what every link with IPv6 carries in one packet, less the room of a
// tunnel.
inline constexpr size_t kDatagramBytes = 1200;
inline constexpr size_t kDatagramHeadBytes = 17;
inline constexpr size_t kDatagramTagBytes = 16;
inline constexpr size_t kDatagramPayloadBytes =
    kDatagramBytes - kDatagramHeadBytes - kDatagramTagBytes;
inline constexpr size_t kDatagramKeyBytes = 32;

// Returns the id of the key that `datagram` names; nothing if it is no datagram of this version.
std::optional<uint64_t> KeyIdOf(absl::string_view datagram);

// Returns random bytes for a new key, or for its id. INTERNAL if the system has none.
absl::StatusOr<std::string> DrawKeyBytes(size_t size);

// What became of a datagram that has arrived.
enum class Opened {
  kOk,
  kMalformed,  // of another version or key, or too long or too short
  kReplayed,   // it has arrived before, or newer ones have long ago
  kForged,     // it was not sealed with the key
};

// Which numbers of one direction have arrived, as in RFC 6479: what comes twice, or long after
// newer ones, is refused.
class ReplayWindow {
 public:
  // Numbers that are this far behind the newest one count as replayed.
  static constexpr uint64_t kSize = 1024;

  // Returns whether `number` would be new.
  bool IsNew(uint64_t number) const;
  // Notes `number`. Returns whether it is the newest one. REQUIRES: IsNew(number).
  bool Add(uint64_t number);

 private:
  static constexpr uint64_t kBits = 64;  // of a word
  static constexpr uint64_t kWords = kSize / kBits + 1;

  uint64_t past_ = 0;  // the number behind the newest one
  std::array<uint64_t, kWords> seen_ = {};
};

class SealedChannel {
 public:
  enum class End { kRobot, kServer };

  // Datagrams that one end may seal: far below what the cipher allows, so that keys do not live for
  // ever.
  static constexpr uint64_t kMostDatagrams = uint64_t{1} << 32;

  // Returns INVALID_ARGUMENT if the key does not have 32 bytes, INTERNAL if OpenSSL fails.
  static absl::StatusOr<std::unique_ptr<SealedChannel>> Create(uint64_t key_id,
                                                               absl::string_view key, End end);
  ~SealedChannel();
  SealedChannel(const SealedChannel&) = delete;
  SealedChannel& operator=(const SealedChannel&) = delete;

  uint64_t key_id() const { return key_id_; }
  // Returns how many datagrams this end has sealed.
  uint64_t sealed() const { return sealed_; }

  // Writes the next datagram. Returns false if `payload` has more than kDatagramPayloadBytes, or
  // after kMostDatagrams.
  bool Seal(absl::string_view payload, std::string* datagram);

  // Opens a datagram of the other end. If it is one, writes its payload, and whether no newer one
  // has arrived before.
  Opened Open(absl::string_view datagram, std::string* payload, bool* is_newest);

 private:
  struct FreeCipher {
    void operator()(evp_cipher_ctx_st* cipher) const;
  };
  using Cipher = std::unique_ptr<evp_cipher_ctx_st, FreeCipher>;

  explicit SealedChannel(uint64_t key_id) : key_id_(key_id) {}
  // Returns null if OpenSSL fails.
  static Cipher MakeCipher(absl::string_view key, absl::string_view direction, bool seals);

  const uint64_t key_id_;
  Cipher seal_;
  Cipher open_;
  uint64_t sealed_ = 0;
  ReplayWindow arrived_;
};

}  // namespace spikeserve
