#include "server/transport/transport_loop.h"

#include <pthread.h>

#include <utility>
#include <vector>

#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"

namespace spikeserve {

absl::StatusOr<std::unique_ptr<TransportLoop>> TransportLoop::Create(const TransportLimits* limits,
                                                                     TransportBudgets* budgets,
                                                                     const Clock* clock) {
  ASSIGN_OR_RETURN(auto events, EventLoop::Create(clock));
  return std::unique_ptr<TransportLoop>(
      new TransportLoop(limits, budgets, clock, std::move(events)));
}

TransportLoop::TransportLoop(const TransportLimits* limits, TransportBudgets* budgets,
                             const Clock* clock, std::unique_ptr<EventLoop> events)
    : events_(std::move(events)),
      shared_({.loop = events_.get(),
               .clock = clock,
               .router = nullptr,
               .limits = limits,
               .budgets = budgets,
               .closed =
                   [this](Connection* connection) {
                     auto node = connections_.extract(connection->number());
                     if (!node.empty()) events_->DeleteLater(std::move(node.mapped()));
                   },
               .unauthenticated_queue = UnauthenticatedQueue(events_.get(), clock)}) {}

TransportLoop::~TransportLoop() { Join(); }

void TransportLoop::Run() {
  SPIKESERVE_DCHECK(!thread_.joinable());
  events_->AtEndOfTurn([this] { FlushWrites(); });
  CheckTimes();
  thread_ = std::thread([this] {
    pthread_setname_np(pthread_self(), "loop");  // for those who look at the threads of the process
    events_->Run();
  });
}

void TransportLoop::Join() {
  if (!thread_.joinable()) return;
  events_->Stop();
  thread_.join();
  while (!connections_.empty()) connections_.begin()->second->Close();
}

void TransportLoop::Adopt(std::unique_ptr<Socket> socket, std::unique_ptr<ConnectionSlot> slot) {
  SPIKESERVE_DCHECK(socket != nullptr && slot != nullptr);
  auto connection = std::make_unique<Connection>(std::move(socket), std::move(slot), &shared_);
  Connection& adopted = *connection;
  connections_.emplace(adopted.number(), std::move(connection));
  if (!adopted.Start().ok()) adopted.Close();
}

void TransportLoop::CloseSoon(uint64_t number) {
  events_->Post([this, number] {
    const auto found = connections_.find(number);
    if (found != connections_.end()) found->second->Drop();
  });
}

void TransportLoop::FlushWrites() {
  events_->thread().AssertCurrent();
  for (Connection* connection : std::exchange(shared_.to_flush, {})) connection->Flush();
  if (datagrams_ != nullptr) datagrams_->Flush();
}

void TransportLoop::CheckTimes() {
  std::vector<Connection*> connections;  // a check may close its connection
  connections.reserve(connections_.size());
  for (const auto& [key, connection] : connections_) connections.push_back(connection.get());
  for (Connection* connection : connections) connection->CheckTimes();
  events_->After(Connection::kCheckInterval, [this] { CheckTimes(); });
}

void TransportLoop::Drain() {
  events_->thread().AssertCurrent();
  for (const auto& [key, connection] : connections_) connection->Drain();
}

void TransportLoop::GoAway() {
  events_->thread().AssertCurrent();
  for (const auto& [key, connection] : connections_) connection->GoAway();
}

}  // namespace spikeserve
