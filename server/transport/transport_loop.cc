#include "server/transport/transport_loop.h"

#include <utility>
#include <vector>

namespace spikeserve {
namespace {

// The interval of checking time limits.
constexpr absl::Duration kCheckInterval = absl::Seconds(1);

}  // namespace

absl::StatusOr<std::unique_ptr<TransportLoop>> TransportLoop::Create(const TransportLimits* limits,
                                                                     ByteBudget* bytes_in_flight,
                                                                     const Clock* clock) {
  auto events = EventLoop::Create(clock);
  if (!events.ok()) return events.status();
  return std::unique_ptr<TransportLoop>(
      new TransportLoop(limits, bytes_in_flight, clock, *std::move(events)));
}

TransportLoop::TransportLoop(const TransportLimits* limits, ByteBudget* bytes_in_flight,
                             const Clock* clock, std::unique_ptr<EventLoop> events)
    : events_(std::move(events)),
      shared_({.loop = events_.get(),
               .clock = clock,
               .router = nullptr,
               .limits = limits,
               .bytes_in_flight = bytes_in_flight,
               .closed =
                   [this](Connection* connection) {
                     strangers_.erase(AgeOf(connection));
                     auto node = connections_.extract(connection);
                     if (!node.empty()) events_->DeleteLater(std::move(node.mapped()));
                   },
               .stranger_queue = StrangerQueue(events_.get(), clock),
               .called = [this](Connection* connection) { strangers_.erase(AgeOf(connection)); }}) {
}

TransportLoop::~TransportLoop() { Join(); }

void TransportLoop::Run() {
  events_->AtEndOfTurn([this] { FlushWrites(); });
  CheckTimes();
  thread_ = std::thread([this] { events_->Run(); });
}

void TransportLoop::Join() {
  if (!thread_.joinable()) return;
  events_->Stop();
  thread_.join();
  while (!connections_.empty()) connections_.begin()->second->Close();
}

void TransportLoop::Adopt(std::unique_ptr<Socket> socket, std::unique_ptr<ConnectionSlot> slot) {
  auto connection = std::make_unique<Connection>(std::move(socket), std::move(slot), &shared_);
  Connection* key = connection.get();
  connections_.emplace(key, std::move(connection));
  strangers_.insert(AgeOf(key));
  if (!key->Start().ok()) key->Close();
}

void TransportLoop::CloseOldestStranger() {
  if (!strangers_.empty()) strangers_.begin()->second->Close();
}

void TransportLoop::FlushWrites() {
  for (Connection* connection : std::exchange(shared_.to_flush, {})) connection->Flush();
}

void TransportLoop::CheckTimes() {
  std::vector<Connection*> connections;  // a check may close its connection
  connections.reserve(connections_.size());
  for (const auto& [key, connection] : connections_) connections.push_back(key);
  for (Connection* connection : connections) connection->CheckTimes();
  events_->After(kCheckInterval, [this] { CheckTimes(); });
}

void TransportLoop::Drain() {
  for (const auto& [key, connection] : connections_) connection->Drain();
}

void TransportLoop::GoAway() {
  for (const auto& [key, connection] : connections_) connection->GoAway();
}

}  // namespace spikeserve
