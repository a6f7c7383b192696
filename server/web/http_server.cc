#include "server/web/http_server.h"

#include <utility>

#include "absl/time/time.h"
#include "server/transport/event_loop.h"
#include "server/transport/listener.h"
#include "server/web/http_loop.h"

namespace spikeserve {
namespace {

constexpr absl::Duration kStopTimeout = absl::Seconds(1);

}  // namespace

HttpServer::HttpServer(Address address, std::unique_ptr<HttpLoop> loop)
    : address_(std::move(address)), loop_(std::move(loop)) {}

absl::StatusOr<std::unique_ptr<HttpServer>> HttpServer::Start(const Options& options, Page page) {
  auto listeners = Listen("--http_listen", options.listen);
  if (!listeners.ok()) return listeners.status();
  auto events = EventLoop::Create(options.clock);
  if (!events.ok()) return events.status();
  auto loop = std::make_unique<HttpLoop>(*std::move(events), options, std::move(page));
  if (auto status = loop->Run(std::move(listeners->sockets)); !status.ok()) return status;
  return std::unique_ptr<HttpServer>(new HttpServer(listeners->address, std::move(loop)));
}

HttpServer::~HttpServer() { loop_->Stop(kStopTimeout); }

}  // namespace spikeserve
