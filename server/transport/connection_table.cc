#include "server/transport/connection_table.h"

#include "absl/container/flat_hash_map.h"
#include "server/base/log.h"

namespace spikeserve {
namespace {

void CountDown(absl::flat_hash_map<std::string, int64_t>* counts, const std::string& name) {
  const auto found = counts->find(name);
  if (--found->second == 0) counts->erase(found);
}

int64_t CountOf(const absl::flat_hash_map<std::string, int64_t>& counts, const std::string& name) {
  const auto found = counts.find(name);
  return found == counts.end() ? 0 : found->second;
}

}  // namespace

void UnauthenticatedIndex::Add(ConnectionSlot* slot, const ClientOrigin& origin, Rank rank) {
  hosts_[origin.host].emplace(rank, slot);
  const auto network = networks_.try_emplace(origin.network).first;
  Members& members = network->second;
  by_size_.erase({members.size(), network->first});
  members.emplace(rank, slot);
  by_size_.emplace(members.size(), network->first);
  ++size_;
}

void UnauthenticatedIndex::Remove(const ClientOrigin& origin, Rank rank) {
  const auto host = hosts_.find(origin.host);
  host->second.erase(rank);
  if (host->second.empty()) hosts_.erase(host);
  const auto network = networks_.find(origin.network);
  Members& members = network->second;
  by_size_.erase({members.size(), network->first});
  members.erase(rank);
  --size_;
  if (members.empty()) {
    networks_.erase(network);
  } else {
    by_size_.emplace(members.size(), network->first);
  }
}

ConnectionSlot* UnauthenticatedIndex::FirstOf(const Groups& groups, const std::string& name) {
  const auto found = groups.find(name);
  return found == groups.end() ? nullptr : found->second.begin()->second;
}

ConnectionSlot* UnauthenticatedIndex::FirstOfLargestNetwork() const {
  if (by_size_.empty()) return nullptr;
  return networks_.find(std::string(by_size_.rbegin()->second))->second.begin()->second;
}

absl::string_view ToString(ConnectionLimit limit) {
  switch (limit) {
    case ConnectionLimit::kConnections:
      return "max_connections";
    case ConnectionLimit::kPerAddress:
      return "max_connections_per_address";
    case ConnectionLimit::kPerNetwork:
      return "max_connections_per_network";
    case ConnectionLimit::kReserve:
      return "reserve";
    case ConnectionLimit::kIdleUnauthenticated:
      return "max_idle_unauthenticated";
    case ConnectionLimit::kUnauthenticatedBytes:
      return "max_unauthenticated_bytes";
    case ConnectionLimit::kFileDescriptors:
      return "open_files";
  }
  return "";
}

std::unique_ptr<ConnectionSlot> ConnectionTable::Admit(const ClientOrigin& origin,
                                                       ConnectionCloser* closer) {
  absl::MutexLock lock(&mutex_);
  if (const auto limit = MakeRoom(origin); limit.has_value()) {
    ++counts_.refused[static_cast<size_t>(*limit)];
    LogWarning("connection refused", {{"client", origin.address}, {"limit", ToString(*limit)}});
    return nullptr;
  }
  auto slot = std::make_unique<ConnectionSlot>(this, origin, next_number_++, closer);
  ++counts_.open;
  ++by_host_[origin.host];
  ++by_network_[origin.network];
  Index(slot.get(), /*has_called=*/false);
  return slot;
}

std::optional<ConnectionLimit> ConnectionTable::MakeRoom(const ClientOrigin& origin) {
  if (CountOf(by_host_, origin.host) >= limits_.per_address &&
      !Drop(unauthenticated_.FirstOfHost(origin.host), ConnectionLimit::kPerAddress)) {
    return ConnectionLimit::kPerAddress;
  }
  if (CountOf(by_network_, origin.network) >= limits_.per_network &&
      !Drop(unauthenticated_.FirstOfNetwork(origin.network), ConnectionLimit::kPerNetwork)) {
    return ConnectionLimit::kPerNetwork;
  }
  if (counts_.open >= limits_.connections &&
      !Drop(unauthenticated_.FirstOfLargestNetwork(), ConnectionLimit::kConnections)) {
    return ConnectionLimit::kConnections;
  }
  if (unauthenticated_.size() >= max_unauthenticated_) {
    Drop(unauthenticated_.FirstOfLargestNetwork(), ConnectionLimit::kReserve);
  }
  if (idle_unauthenticated_.size() >= limits_.idle_unauthenticated) {
    Drop(idle_unauthenticated_.FirstOfLargestNetwork(), ConnectionLimit::kIdleUnauthenticated);
  }
  return std::nullopt;
}

bool ConnectionTable::Drop(ConnectionSlot* slot, ConnectionLimit reason) {
  if (slot == nullptr) return false;
  Leave(slot);
  slot->was_dropped_ = true;
  slot->will_free_ = true;
  ++dropping_;
  ++counts_.dropped[static_cast<size_t>(reason)];
  LogWarning("unauthenticated connection dropped",
             {{"client", slot->origin_.address}, {"limit", ToString(reason)}});
  slot->closer_->CloseSoon(slot->number_);
  return true;
}

void ConnectionTable::DropUnauthenticated(ConnectionLimit reason, int64_t bytes) {
  absl::MutexLock lock(&mutex_);
  while (dropping_ * kConnectionBytes < bytes &&
         Drop(unauthenticated_.FirstOfLargestNetwork(), reason)) {
  }
}

void ConnectionTable::CountRefused(ConnectionLimit reason) {
  absl::MutexLock lock(&mutex_);
  ++counts_.refused[static_cast<size_t>(reason)];
}

ConnectionTable::Counts ConnectionTable::counts() const {
  absl::MutexLock lock(&mutex_);
  Counts counts = counts_;
  counts.unauthenticated = unauthenticated_.size();
  return counts;
}

void ConnectionTable::Index(ConnectionSlot* slot, bool has_called) {
  slot->rank_ = {has_called, slot->number_};
  unauthenticated_.Add(slot, slot->origin_, *slot->rank_);
  if (!has_called) idle_unauthenticated_.Add(slot, slot->origin_, *slot->rank_);
}

void ConnectionTable::Unindex(ConnectionSlot* slot) {
  const auto rank = std::exchange(slot->rank_, std::nullopt);
  if (!rank.has_value()) return;
  unauthenticated_.Remove(slot->origin_, *rank);
  const bool has_called = rank->first;
  if (!has_called) idle_unauthenticated_.Remove(slot->origin_, *rank);
}

void ConnectionTable::Leave(ConnectionSlot* slot) {
  Unindex(slot);
  --counts_.open;
  CountDown(&by_host_, slot->origin_.host);
  CountDown(&by_network_, slot->origin_.network);
}

void ConnectionTable::MarkCaller(ConnectionSlot* slot) {
  absl::MutexLock lock(&mutex_);
  if (!slot->rank_.has_value()) return;  // dropped
  Unindex(slot);
  Index(slot, /*has_called=*/true);
}

void ConnectionTable::MarkKnown(ConnectionSlot* slot) {
  absl::MutexLock lock(&mutex_);
  Unindex(slot);
  StopExpecting(slot);
}

void ConnectionTable::MarkFreed(ConnectionSlot* slot) {
  absl::MutexLock lock(&mutex_);
  StopExpecting(slot);
}

void ConnectionTable::StopExpecting(ConnectionSlot* slot) {
  if (std::exchange(slot->will_free_, false)) --dropping_;
}

void ConnectionTable::Remove(ConnectionSlot* slot) {
  absl::MutexLock lock(&mutex_);
  ++counts_.closed;
  StopExpecting(slot);
  if (!slot->was_dropped_) Leave(slot);
}

}  // namespace spikeserve
