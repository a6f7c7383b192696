// Bounds how many connections the process, and each client address, may have.
//
// Thread-safe. Must outlive its slots.
#ifndef SERVER_TRANSPORT_CONNECTION_TABLE_H_
#define SERVER_TRANSPORT_CONNECTION_TABLE_H_

#include <cstdint>
#include <memory>
#include <string>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/container/flat_hash_map.h"
#include "absl/synchronization/mutex.h"

namespace spikeserve {

class ConnectionSlot;

class ConnectionTable {
 public:
  ConnectionTable(int64_t max_connections, int64_t max_per_address)
      : max_connections_(max_connections), max_per_address_(max_per_address) {}

  // Returns the place of a connection from `address`, a stranger's at first; null if there is none
  // left.
  std::unique_ptr<ConnectionSlot> Admit(const std::string& address);

  int64_t connections() const;
  // Returns the number of connections that were closed so far.
  int64_t closed() const;
  // Returns the number of connections that have not made a call yet.
  int64_t strangers() const;

 private:
  friend class ConnectionSlot;

  void RemoveStranger();
  void Remove(const std::string& address);

  const int64_t max_connections_;
  const int64_t max_per_address_;
  mutable absl::Mutex mutex_;
  int64_t connections_ ABSL_GUARDED_BY(mutex_) = 0;
  int64_t closed_ ABSL_GUARDED_BY(mutex_) = 0;
  int64_t strangers_ ABSL_GUARDED_BY(mutex_) = 0;
  absl::flat_hash_map<std::string, int64_t> by_address_ ABSL_GUARDED_BY(mutex_);
};

// A connection's place in the table, which the destructor gives back. Not thread-safe.
class ConnectionSlot {
 public:
  ConnectionSlot(ConnectionTable* table, std::string address)
      : table_(table), address_(std::move(address)) {}
  ~ConnectionSlot() {
    MarkCaller();
    table_->Remove(address_);
  }
  ConnectionSlot(const ConnectionSlot&) = delete;
  ConnectionSlot& operator=(const ConnectionSlot&) = delete;

  // The connection has made a call.
  void MarkCaller() {
    if (std::exchange(is_stranger_, false)) table_->RemoveStranger();
  }
  bool is_stranger() const { return is_stranger_; }
  const std::string& address() const { return address_; }

 private:
  ConnectionTable* const table_;
  const std::string address_;
  bool is_stranger_ = true;
};

}  // namespace spikeserve

#endif  // SERVER_TRANSPORT_CONNECTION_TABLE_H_
