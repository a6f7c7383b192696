// The keys with which the robots of this server's sessions seal datagrams.
//
//   channels.Open(entry, caller, response->mutable_datagrams());  // the session gets a key
//   const auto key = channels.Find(*KeyIdOf(datagram));           // null: no such key
//   key->Open(datagram, from, &payload);
//
// A session has the key that its robot uses, and at most one that follows it. Its keys end when its
// entry does: by CloseSession, by expiry, or because another server has taken it over.
//
// Thread-safe.
#pragma once

#include <array>
#include <atomic>
#include <cstdint>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/container/flat_hash_map.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "core/datagram/sealed_channel.h"
#include "core/open_sessions/session_store.h"
#include "server/access/authenticator.h"
#include "server/agent/call_context.h"
#include "server/base/byte_budget.h"
#include "server/base/socket_address.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// What became of a datagram that has arrived.
enum class DatagramOutcome {
  kTaken,
  kMalformed,
  kUnknownKey,
  kReplayed,
  kForged,
  kRefused,  // the caller has been refused, or has too many requests that wait
};
inline constexpr size_t kDatagramOutcomes = 6;

// One key of one session. Thread-safe.
class DatagramKey {
 public:
  DatagramKey(std::unique_ptr<SealedChannel> channel, const std::shared_ptr<SessionEntry>& entry,
              std::string session_id, std::shared_ptr<const Credential> caller, absl::Duration now)
      : session_id_(std::move(session_id)),
        caller_(std::move(caller)),
        opened_at_(now),
        entry_(entry),
        id_(channel->key_id()),
        channel_(std::move(channel)) {}

  uint64_t id() const { return id_; }
  const std::string& session_id() const { return session_id_; }
  const Credential& caller() const { return *caller_; }  // for whom the key was made
  absl::Duration opened_at() const { return opened_at_; }
  bool is_open() const { return !entry_.expired(); }  // the session is here
  bool is_used() const { return is_used_.load(std::memory_order_relaxed); }
  // Returns whether so many datagrams were sealed that another key should follow.
  bool is_worn() const ABSL_LOCKS_EXCLUDED(mutex_);

  // Opens a datagram of the robot. The newest one tells where answers go.
  DatagramOutcome Open(absl::string_view datagram, const SocketAddress& from, std::string* payload)
      ABSL_LOCKS_EXCLUDED(mutex_);
  // What is to be sent to the robot.
  struct Answers {
    SocketAddress to;
    std::vector<std::string> datagrams;
  };
  // Returns whether the newest request has this number, too, and this one is a copy of it. Adds its
  // answer to `answers`, which is sent again, or lets it be sent once more when it is there.
  bool IsCopy(absl::string_view number, Answers* answers) ABSL_LOCKS_EXCLUDED(mutex_);
  // Seals the answer to the request of this number, once for each copy that has arrived. Adds
  // nothing to `answers` if it is too long.
  void Answer(absl::string_view number, std::string payload, Answers* answers)
      ABSL_LOCKS_EXCLUDED(mutex_);

  // Counts a request that is handled, unless too many are, or the caller is to be delayed after a
  // refusal. Returns whether it was counted; then, Leave() follows.
  bool Enter(absl::Duration now);
  void Leave() { in_progress_.fetch_sub(1, std::memory_order_relaxed); }
  void DelayUntil(absl::Duration time) {
    delayed_until_ns_.store(absl::ToInt64Nanoseconds(time), std::memory_order_relaxed);
  }

 private:
  // As many as a stream may have without an answer.
  static constexpr int kMostInProgress = 64;

  const std::string session_id_;
  const std::shared_ptr<const Credential> caller_;
  const absl::Duration opened_at_;
  const std::weak_ptr<SessionEntry> entry_;
  const uint64_t id_;
  std::atomic<bool> is_used_ = false;  // a datagram was opened
  std::atomic<int> in_progress_ = 0;
  std::atomic<int64_t> delayed_until_ns_ = 0;
  mutable absl::Mutex mutex_;
  void Seal(Answers* answers) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  const std::unique_ptr<SealedChannel> channel_ ABSL_PT_GUARDED_BY(mutex_);
  SocketAddress address_ ABSL_GUARDED_BY(mutex_);  // of the newest datagram
  // Of the newest request.
  std::string number_ ABSL_GUARDED_BY(mutex_);
  std::string answer_ ABSL_GUARDED_BY(mutex_);  // empty: there is none yet
  int copies_ ABSL_GUARDED_BY(mutex_) = 0;      // that have no answer
};

class DatagramChannels {
 public:
  // `clock` must outlive the object.
  explicit DatagramChannels(const Clock* clock) : clock_(clock) {}

  // Sets where robots send their datagrams, as HOST:PORT. Once, before the first session.
  void SetEndpoint(std::string endpoint) { endpoint_ = std::move(endpoint); }

  // Gives the session another key, for `caller`, and describes it in `response`. Nothing if OpenSSL
  // fails: then there are no datagrams.
  void Open(const std::shared_ptr<SessionEntry>& entry, const Credential& caller,
            v1::OpenSessionResponse* response);
  // Notes how the request has come. As Open, in its answer, if the session wants datagrams and
  // needs a key: it has none here, its key is old or worn or its token is not valid any more, or
  // the robot has not used the one that it was given.
  void Renew(const std::shared_ptr<SessionEntry>& entry, const CallContext& context,
             v1::ActResponse* response);
  // Returns whether the session's last step came as a datagram. REQUIRES: the entry's lock is held.
  static bool CarriesSteps(const SessionEntry& entry);

  // Returns the key with this id, or null.
  std::shared_ptr<DatagramKey> Find(uint64_t id) ABSL_LOCKS_EXCLUDED(keys_->mutex);
  // Ends a key before its time.
  void Remove(const DatagramKey& key) { keys_->Remove(key.id()); }

  // What the requests in progress occupy.
  ByteBudget& bytes_in_flight() { return bytes_in_flight_; }

  void Count(DatagramOutcome outcome) {
    counts_[static_cast<size_t>(outcome)].fetch_add(1, std::memory_order_relaxed);
  }
  int64_t count(DatagramOutcome outcome) const {
    return counts_[static_cast<size_t>(outcome)].load(std::memory_order_relaxed);
  }

 private:
  friend class SessionDatagrams;

  // Outlives the object while there are sessions.
  struct Keys {
    void Remove(uint64_t id) ABSL_LOCKS_EXCLUDED(mutex);

    absl::Mutex mutex;
    absl::flat_hash_map<uint64_t, std::shared_ptr<DatagramKey>> by_id ABSL_GUARDED_BY(mutex);
  };

  // Returns the description of another key; INTERNAL if OpenSSL fails.
  absl::StatusOr<v1::DatagramChannel> Add(const std::shared_ptr<SessionEntry>& entry,
                                          const Credential& caller)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(entry->mutex);

  const Clock* const clock_;
  const std::shared_ptr<Keys> keys_ = std::make_shared<Keys>();
  std::string endpoint_;
  ByteBudget bytes_in_flight_;
  std::array<std::atomic<int64_t>, kDatagramOutcomes> counts_ = {};
};

}  // namespace spikeserve
