#include "server/agent/datagram_channels.h"

#include <cstring>
#include <utility>

#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

// A key lives for an hour, and another one follows it after half of that, so that the robot has
// time to take it.
constexpr absl::Duration kKeyLife = absl::Hours(1);
constexpr absl::Duration kKeyAge = absl::Minutes(30);
constexpr uint64_t kKeyDatagrams = uint64_t{1} << 24;

// The answer with a key may have been lost, or a firewall stops the datagrams.
constexpr absl::Duration kUnusedAge = absl::Minutes(1);

}  // namespace

// The keys of one session. Guarded by the lock of its entry.
class SessionDatagrams {
 public:
  explicit SessionDatagrams(std::shared_ptr<DatagramChannels::Keys> keys)
      : keys_(std::move(keys)) {}
  ~SessionDatagrams() {
    Drop(&used_);
    Drop(&newest_);
  }
  SessionDatagrams(const SessionDatagrams&) = delete;
  SessionDatagrams& operator=(const SessionDatagrams&) = delete;

  bool NeedsKey(absl::Duration now) const {
    if (newest_ == nullptr || !newest_->caller().CheckValid().ok()) return true;
    const absl::Duration age = now - newest_->opened_at();
    return newest_->is_used() ? age > kKeyAge || newest_->is_worn() : age > kUnusedAge;
  }

  bool carries_steps() const { return carries_steps_; }
  void Note(bool is_datagram) { carries_steps_ = is_datagram; }

  // Keeps the key that the robot uses until it uses the new one.
  void Add(std::shared_ptr<DatagramKey> key) {
    if (newest_ != nullptr && newest_->is_used()) newest_.swap(used_);
    Drop(&newest_);
    newest_ = std::move(key);
  }

 private:
  void Drop(std::shared_ptr<DatagramKey>* key) {
    if (*key != nullptr) keys_->Remove((*key)->id());
    key->reset();
  }

  const std::shared_ptr<DatagramChannels::Keys> keys_;
  std::shared_ptr<DatagramKey> used_;
  std::shared_ptr<DatagramKey> newest_;
  bool carries_steps_ = false;  // the last one came as a datagram
};

bool DatagramKey::is_worn() const {
  absl::MutexLock lock(&mutex_);
  return channel_->sealed() > kKeyDatagrams;
}

DatagramOutcome DatagramKey::Open(absl::string_view datagram, const SocketAddress& from,
                                  std::string* payload) {
  absl::MutexLock lock(&mutex_);
  bool is_newest = false;
  switch (channel_->Open(datagram, payload, &is_newest)) {
    case Opened::kMalformed:
      return DatagramOutcome::kMalformed;
    case Opened::kReplayed:
      return DatagramOutcome::kReplayed;
    case Opened::kForged:
      return DatagramOutcome::kForged;
    case Opened::kOk:
      break;
  }
  if (is_newest) address_ = from;
  is_used_.store(true, std::memory_order_relaxed);
  return DatagramOutcome::kTaken;
}

bool DatagramKey::IsCopy(absl::string_view number, Answers* answers) {
  absl::MutexLock lock(&mutex_);
  if (number_ != number) {
    number_ = std::string(number);
    answer_.clear();
    copies_ = 1;
    return false;
  }
  if (answer_.empty()) {
    ++copies_;
  } else {
    Seal(answers);
  }
  return true;
}

void DatagramKey::Answer(absl::string_view number, std::string payload, Answers* answers) {
  absl::MutexLock lock(&mutex_);
  const bool is_newest = number_ == number;
  std::swap(answer_, payload);
  const int copies = is_newest ? std::exchange(copies_, 0) : 1;
  for (int i = 0; i < copies; ++i) Seal(answers);
  if (!is_newest) answer_ = std::move(payload);
}

void DatagramKey::Seal(Answers* answers) {
  std::string datagram;
  if (!channel_->Seal(answer_, &datagram)) return;
  answers->to = address_;
  answers->datagrams.push_back(std::move(datagram));
}

bool DatagramKey::Enter(absl::Duration now) {
  if (absl::ToInt64Nanoseconds(now) < delayed_until_ns_.load(std::memory_order_relaxed)) {
    return false;
  }
  if (in_progress_.fetch_add(1, std::memory_order_relaxed) < kMostInProgress) return true;
  Leave();
  return false;
}

void DatagramChannels::Keys::Remove(uint64_t id) {
  absl::MutexLock lock(&mutex);
  by_id.erase(id);
}

std::shared_ptr<DatagramKey> DatagramChannels::Find(uint64_t id) {
  std::shared_ptr<DatagramKey> key;
  {
    absl::ReaderMutexLock lock(&keys_->mutex);
    const auto found = keys_->by_id.find(id);
    if (found == keys_->by_id.end()) return nullptr;
    key = found->second;
  }
  const bool is_valid = key->is_open() && clock_->Now() - key->opened_at() < kKeyLife &&
                        key->caller().CheckValid().ok();
  if (is_valid) return key;
  Remove(*key);
  return nullptr;
}

void DatagramChannels::Open(const std::shared_ptr<SessionEntry>& entry, const Credential& caller,
                            v1::OpenSessionResponse* response) {
  absl::MutexLock lock(&entry->mutex);
  auto channel = Add(entry, caller);
  if (channel.ok()) *response->mutable_datagrams() = *std::move(channel);
}

bool DatagramChannels::CarriesSteps(const SessionEntry& entry) {
  entry.mutex.AssertHeld();
  return entry.datagrams != nullptr && entry.datagrams->carries_steps();
}

void DatagramChannels::Renew(const std::shared_ptr<SessionEntry>& entry, const CallContext& context,
                             v1::ActResponse* response) {
  if (!entry->wants_datagrams) return;
  absl::MutexLock lock(&entry->mutex);
  if (entry->datagrams != nullptr) {
    entry->datagrams->Note(context.is_datagram);
    if (!entry->datagrams->NeedsKey(clock_->Now())) return;
  }
  auto channel = Add(entry, *context.caller);
  if (channel.ok()) *response->mutable_datagrams() = *std::move(channel);
}

absl::StatusOr<v1::DatagramChannel> DatagramChannels::Add(
    const std::shared_ptr<SessionEntry>& entry, const Credential& caller) {
  entry->mutex.AssertHeld();
  if (entry->datagrams == nullptr) entry->datagrams = std::make_shared<SessionDatagrams>(keys_);
  // Drawn at random, so that ids tell nothing about other sessions. Two equal ones do not occur.
  ASSIGN_OR_RETURN(const std::string id_bytes, DrawKeyBytes(sizeof(uint64_t)));
  ASSIGN_OR_RETURN(const std::string key_bytes, DrawKeyBytes(kDatagramKeyBytes));
  uint64_t id = 0;
  std::memcpy(&id, id_bytes.data(), sizeof(id));
  ASSIGN_OR_RETURN(auto sealed, SealedChannel::Create(id, key_bytes, SealedChannel::End::kServer));
  auto key = std::make_shared<DatagramKey>(std::move(sealed), entry, entry->agent.session().id,
                                           caller.shared_from_this(), clock_->Now());
  {
    absl::MutexLock lock(&keys_->mutex);
    keys_->by_id[id] = key;
  }
  entry->datagrams->Add(std::move(key));
  v1::DatagramChannel channel;
  channel.set_endpoint(endpoint_);
  channel.set_key_id(id);
  channel.set_key(key_bytes);
  channel.set_valid_seconds(absl::ToDoubleSeconds(kKeyLife));
  return channel;
}

}  // namespace spikeserve
