#include "server/transport/connection_table.h"

namespace spikeserve {

std::unique_ptr<ConnectionSlot> ConnectionTable::Admit(const std::string& address) {
  {
    absl::MutexLock lock(&mutex_);
    if (connections_ >= max_connections_) return nullptr;
    int64_t& from_address = by_address_[address];
    if (from_address >= max_per_address_) return nullptr;
    ++from_address;
    ++connections_;
    ++strangers_;
  }
  return std::make_unique<ConnectionSlot>(this, address);
}

int64_t ConnectionTable::connections() const {
  absl::MutexLock lock(&mutex_);
  return connections_;
}

int64_t ConnectionTable::closed() const {
  absl::MutexLock lock(&mutex_);
  return closed_;
}

int64_t ConnectionTable::strangers() const {
  absl::MutexLock lock(&mutex_);
  return strangers_;
}

void ConnectionTable::RemoveStranger() {
  absl::MutexLock lock(&mutex_);
  --strangers_;
}

void ConnectionTable::Remove(const std::string& address) {
  absl::MutexLock lock(&mutex_);
  --connections_;
  ++closed_;
  const auto found = by_address_.find(address);
  if (--found->second == 0) by_address_.erase(found);
}

}  // namespace spikeserve
