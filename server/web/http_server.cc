#include "server/web/http_server.h"

#include <utility>

#include "absl/time/time.h"
#include "core/base/status_macros.h"
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
  ASSIGN_OR_RETURN(auto listeners, Listen("--http_listen", options.listen));
  ASSIGN_OR_RETURN(auto events, EventLoop::Create(options.clock));
  auto loop = std::make_unique<HttpLoop>(std::move(events), options, std::move(page));
  RETURN_IF_ERROR(loop->Run(std::move(listeners.sockets)));
  return std::unique_ptr<HttpServer>(new HttpServer(listeners.address, std::move(loop)));
}

HttpServer::~HttpServer() { loop_->Stop(kStopTimeout); }

}  // namespace spikeserve
