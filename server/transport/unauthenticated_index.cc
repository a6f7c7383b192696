#include "server/transport/unauthenticated_index.h"

namespace spikeserve {

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

}  // namespace spikeserve
