// Bounds how many connections the process, each client and each network may have, and decides which
// connection is closed to make room for another.
//
// A connection is unauthenticated until one of its calls was admitted. Such connections cannot hold
// the places of others: a new connection that meets a limit takes the place of an unauthenticated
// one of the same host or network, or else of the network that has the most of them; those without
// a call go first, then the oldest. A part of all places is kept for connections that are known.
//
//   auto slot = table.Admit(origin, &host);
//   if (slot == nullptr) return Refuse();
//   slot->MarkCaller();  // a call has arrived
//   slot->MarkKnown();   // and was admitted
//
// Thread-safe. Must outlive its slots.
#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/container/flat_hash_map.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/mutex.h"
#include "server/transport/client_origin.h"

namespace spikeserve {

class ConnectionSlot;

// Why a connection was refused, or dropped in favour of others.
enum class ConnectionLimit {
  kConnections,           // of the process
  kPerAddress,            // of a host
  kPerNetwork,            // of a network
  kReserve,               // the places that are kept for connections that are known
  kIdleUnauthenticated,   // unauthenticated connections without a call
  kUnauthenticatedBytes,  // what unauthenticated connections store
  kFileDescriptors,       // the process may open no more files
};
inline constexpr size_t kConnectionLimits = 7;

// What a connection occupies apart from its streams: the session of nghttp2 with its HPACK tables,
// and buffers, measured with a server full of connections.
inline constexpr int64_t kConnectionBytes = 28 << 10;

// Returns the name of the flag behind a limit, or another word if it has none.
absl::string_view ToString(ConnectionLimit limit);

// What serves a connection and can close it.
class ConnectionCloser {
 public:
  // Closes the connection with this number soon, unless it is closed already. Thread-safe; returns
  // at once.
  virtual void CloseSoon(uint64_t number) = 0;

 protected:
  ~ConnectionCloser() = default;
};

// Finds the connection that has to go first: of a crowd from one network, the oldest. Not
// thread-safe.
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

class ConnectionTable {
 public:
  struct Limits {
    int64_t connections;
    int64_t per_address;
    int64_t per_network;
    int64_t idle_unauthenticated;
  };
  using CountByLimit = std::array<int64_t, kConnectionLimits>;
  struct Counts {
    int64_t open = 0;
    int64_t unauthenticated = 0;  // of these
    int64_t closed = 0;           // so far
    CountByLimit refused = {};
    CountByLimit dropped = {};
  };

  explicit ConnectionTable(const Limits& limits)
      : limits_(limits),
        max_unauthenticated_(limits.connections - limits.connections / kReservedShare) {}

  // Returns the place of a new connection, unauthenticated at first; null if there is none, which
  // is logged. `closer`, which must outlive the slot, closes the connection if its place is needed.
  std::unique_ptr<ConnectionSlot> Admit(const ClientOrigin& origin, ConnectionCloser* closer);

  // Closes the unauthenticated connections that have to go first, as far as there are some, until
  // `bytes` are freed with those that are about to be closed: each frees at least kConnectionBytes.
  void DropUnauthenticated(ConnectionLimit reason, int64_t bytes);
  // Counts a connection that was refused for another reason than the limits of Admit().
  void CountRefused(ConnectionLimit reason);

  int64_t max_connections() const { return limits_.connections; }
  Counts counts() const;

 private:
  friend class ConnectionSlot;

  // A quarter of all places is kept for connections that are known.
  static constexpr int64_t kReservedShare = 4;

  // Returns the limit that `origin` meets, after unauthenticated connections have made room for it.
  std::optional<ConnectionLimit> MakeRoom(const ClientOrigin& origin)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Closes a connection, whose place is free at once. Returns false if `slot` is null.
  bool Drop(ConnectionSlot* slot, ConnectionLimit reason) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Makes the place of `slot` free.
  void Leave(ConnectionSlot* slot) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Adds `slot` to the indices of unauthenticated connections, or removes it from those in which it
  // is.
  void Index(ConnectionSlot* slot, bool has_called) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void Unindex(ConnectionSlot* slot) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  // Called by slots.
  void MarkCaller(ConnectionSlot* slot);
  void MarkKnown(ConnectionSlot* slot);
  void MarkFreed(ConnectionSlot* slot);
  void Remove(ConnectionSlot* slot);
  // No longer expects a dropped connection to free bytes.
  void StopExpecting(ConnectionSlot* slot) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  const Limits limits_;
  const int64_t max_unauthenticated_;
  mutable absl::Mutex mutex_;
  Counts counts_ ABSL_GUARDED_BY(mutex_);
  int64_t dropping_ ABSL_GUARDED_BY(mutex_) = 0;  // dropped, and will free bytes
  uint64_t next_number_ ABSL_GUARDED_BY(mutex_) = 0;
  UnauthenticatedIndex unauthenticated_ ABSL_GUARDED_BY(mutex_);
  UnauthenticatedIndex idle_unauthenticated_
      ABSL_GUARDED_BY(mutex_);  // those of them without a call
  absl::flat_hash_map<std::string, int64_t> by_host_ ABSL_GUARDED_BY(mutex_);
  absl::flat_hash_map<std::string, int64_t> by_network_ ABSL_GUARDED_BY(mutex_);
};

// A connection's place in the table, which the destructor gives back. Confined to one thread.
class ConnectionSlot {
 public:
  ConnectionSlot(ConnectionTable* table, ClientOrigin origin, uint64_t number,
                 ConnectionCloser* closer)
      : table_(table), origin_(std::move(origin)), number_(number), closer_(closer) {}
  ~ConnectionSlot() { table_->Remove(this); }
  ConnectionSlot(const ConnectionSlot&) = delete;
  ConnectionSlot& operator=(const ConnectionSlot&) = delete;

  // The connection has made a call.
  void MarkCaller() {
    if (!std::exchange(has_called_, true)) table_->MarkCaller(this);
  }
  // A call of the connection was admitted: it is authenticated, see also MarkFreed().
  void MarkKnown() {
    if (!std::exchange(is_known_, true)) table_->MarkKnown(this);
  }
  // The bytes of an unauthenticated connection are about to be freed. If it were called after that,
  // DropUnauthenticated() could expect bytes that are no longer used, and drop too few.
  void MarkFreed() { table_->MarkFreed(this); }
  bool has_called() const { return has_called_; }
  bool is_known() const { return is_known_; }
  uint64_t number() const { return number_; }
  const std::string& address() const { return origin_.address; }
  ConnectionTable& table() { return *table_; }

 private:
  friend class ConnectionTable;

  ConnectionTable* const table_;
  const ClientOrigin origin_;
  const uint64_t number_;  // counts up, so it tells the age
  ConnectionCloser* const closer_;
  bool has_called_ = false;
  bool is_known_ = false;
  // Of the table, under its mutex.
  std::optional<UnauthenticatedIndex::Rank> rank_;  // in its indices; empty: in none
  bool was_dropped_ = false;
  bool will_free_ = false;  // it was dropped, and counts in dropping_
};

}  // namespace spikeserve
