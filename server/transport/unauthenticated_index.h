// Finds the connection that has to go first: of a crowd from one network, the oldest.
//
// Not thread-safe.
#pragma once

#include <cstddef>
#include <cstdint>
#include <map>
#include <set>
#include <string>
#include <utility>

#include "absl/strings/string_view.h"
#include "server/transport/client_origin.h"

namespace spikeserve {

class ConnectionSlot;

class UnauthenticatedIndex {
 public:
  // Orders the connections of one host or network; the first has to go first.
  using Rank = std::pair<bool, uint64_t>;  // has made a call; number of the connection

  // `slot` must be removed, with the same origin and rank, before it is destroyed.
  void Add(ConnectionSlot* slot, const ClientOrigin& origin, Rank rank);
  void Remove(const ClientOrigin& origin, Rank rank);

  int64_t size() const { return size_; }

  // Return null if there is none.
  ConnectionSlot* FirstOfHost(const std::string& host) const { return FirstOf(hosts_, host); }
  ConnectionSlot* FirstOfNetwork(const std::string& network) const {
    return FirstOf(networks_, network);
  }
  ConnectionSlot* FirstOfLargestNetwork() const;

 private:
  using Members = std::map<Rank, ConnectionSlot*>;
  using Groups = std::map<std::string, Members>;

  static ConnectionSlot* FirstOf(const Groups& groups, const std::string& name);

  int64_t size_ = 0;
  Groups hosts_;
  Groups networks_;
  std::set<std::pair<size_t, absl::string_view>> by_size_;  // the keys of `networks_`
};

}  // namespace spikeserve
