#include "server/http_server.h"

#include <civetweb.h>

#include <thread>
#include <utility>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/notification.h"
#include "absl/time/time.h"

namespace spikeserve {
namespace {

// A page may load nothing but what this server sends, be framed by nobody, and is always fetched
// anew.
constexpr absl::string_view kHeaders =
    "Content-Security-Policy: default-src 'none'; script-src 'self'; style-src 'self'; connect-src "
    "'self'; img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'\r\n"
    "X-Content-Type-Options: nosniff\r\n"
    "Referrer-Policy: no-referrer\r\n"
    "Cache-Control: no-store\r\n";

// civetweb looks whether it is to stop when a connection comes, or every two seconds.
void Knock(const Address& address) {
  char error[1];
  mg_close_connection(
      mg_connect_client(address.host.c_str(), address.port, /*use_ssl=*/0, error, sizeof(error)));
}

}  // namespace

absl::StatusOr<std::unique_ptr<HttpServer>> HttpServer::Start(const Address& listen, Page page,
                                                              Guard guard) {
  auto server = std::unique_ptr<HttpServer>(new HttpServer(std::move(page), std::move(guard)));
  const std::string port = listen.ToString();
  const char* options[] = {"listening_ports",    port.c_str(), "num_threads", "4",
                           "request_timeout_ms", "10000",      nullptr};
  mg_callbacks callbacks = {};
  callbacks.begin_request = &HttpServer::Handle;
  callbacks.log_message = &HttpServer::Log;
  server->context_ = mg_start(&callbacks, server.get(), options);
  mg_server_port bound = {};
  if (server->context_ == nullptr || mg_get_server_ports(server->context_, 1, &bound) != 1) {
    return absl::UnavailableError(
        absl::StrCat("cannot listen on ", port, ": ", server->start_error_));
  }
  server->address_ = {.host = listen.host, .port = bound.port};
  return server;
}

HttpServer::~HttpServer() {
  if (context_ == nullptr) return;
  absl::Notification stopped;
  std::thread stop([&] {
    mg_stop(context_);
    stopped.Notify();
  });
  do {
    Knock(address_);
  } while (!stopped.WaitForNotificationWithTimeout(absl::Milliseconds(10)));
  stop.join();
}

int HttpServer::Log(const mg_connection* connection, const char* message) {
  // Only the start's errors are ours to report; later ones are about clients that went away.
  const auto* context = mg_get_context(connection);
  if (context == nullptr) return 1;
  auto* server = static_cast<HttpServer*>(mg_get_user_data(context));
  if (server != nullptr && server->context_ == nullptr && server->start_error_.empty()) {
    server->start_error_ = message;
  }
  return 1;
}

HttpResponse HttpServer::Answer(const mg_connection* connection, const HttpRequest& request) const {
  const char* header = mg_get_header(connection, "Authorization");
  const absl::Status status = guard_(request.path, header == nullptr ? "" : header);
  if (status.ok()) return page_(request);
  return {.code = absl::IsUnauthenticated(status) ? 401 : 403,
          .body = absl::StrCat(status.message(), "\n")};
}

int HttpServer::Handle(mg_connection* connection) {
  const mg_request_info* request = mg_get_request_info(connection);
  const auto* server = static_cast<const HttpServer*>(request->user_data);
  const absl::string_view method = request->request_method;
  const bool head = method == "HEAD";
  const char* query = request->query_string;
  const HttpResponse response =
      head || method == "GET" ? server->Answer(connection, {.path = request->local_uri,
                                                            .query = query == nullptr ? "" : query})
                              : HttpResponse{.code = 405, .body = "expected GET or HEAD\n"};
  const std::string header = absl::StrCat(
      "HTTP/1.1 ", response.code, " ", mg_get_response_code_text(connection, response.code),
      response.code == 401 ? "\r\nWWW-Authenticate: Basic realm=\"spikeserve\"" : "",
      "\r\nContent-Type: ", response.content_type, "\r\nContent-Length: ", response.body.size(),
      "\r\nConnection: close\r\n", kHeaders, "\r\n");
  mg_write(connection, header.data(), header.size());
  if (!head) mg_write(connection, response.body.data(), response.body.size());
  return response.code;  // handled
}

}  // namespace spikeserve
