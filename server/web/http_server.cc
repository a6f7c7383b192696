#include "server/web/http_server.h"

#include <httplib.h>
#include <netdb.h>

#include <cerrno>
#include <utility>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/strip.h"
#include "absl/time/clock.h"
#include "absl/time/time.h"
#include "server/base/listen_reason.h"

namespace spikeserve {
namespace {

constexpr int kThreads = 8;

// The timeout for reading a request, for writing a response and for an idle connection.
constexpr int kTimeoutSeconds = 5;

// Allows a page to load only from this server, forbids framing, and disables caching.
httplib::Headers PageHeaders() {
  return {{"Content-Security-Policy",
           "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src "
           "'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"},
          {"X-Content-Type-Options", "nosniff"},
          {"Referrer-Policy", "no-referrer"},
          {"Cache-Control", "no-store"}};
}

std::unique_ptr<httplib::Server> MakeServer(const TlsFiles* tls) {
  if (!tls->enabled()) return std::make_unique<httplib::Server>();
  return std::make_unique<httplib::SSLServer>([tls](SSL_CTX& context) {
    SetUpTls(tls, &context);
    return true;
  });
}

// Replaces the default of the library, which sets SO_REUSEPORT and so lets another process listen
// on the same port.
void SetSocketOptions(socket_t socket) {
  const int yes = 1;
  setsockopt(socket, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof(yes));
}

// Returns true if the header Host names this machine, with or without a port.
bool NamesThisMachine(absl::string_view host) {
  const size_t colon = host.rfind(':');
  const bool has_port = colon != absl::string_view::npos && host.find(']', colon) == host.npos;
  return Address{.host = std::string(has_port ? host.substr(0, colon) : host)}.is_loopback();
}

// The library sends a part of the body for each range that a request asks for, so a short request
// could get an answer of a hundred megabytes. A server may ignore ranges (RFC 9110, 14.2).
void IgnoreRanges(const httplib::Request& request) {
  // The library passes its own request, which is not constant.
  const_cast<httplib::Ranges&>(request.ranges).clear();  // NOLINT(*-pro-type-const-cast)
}

HttpResponse AnswerOf(const HttpServer::Page& page, bool local_names_only,
                      const httplib::Request& request) {
  if (request.method != "GET" && request.method != "HEAD") {
    return {.code = 405, .body = "expected GET or HEAD\n"};
  }
  // A browser always sends the header; some programs that check health do not.
  if (local_names_only && request.has_header("Host") &&
      !NamesThisMachine(request.get_header_value("Host"))) {
    return {.code = 403, .body = "Host: expected localhost or a loopback address\n"};
  }
  return page({.path = request.path,
               .parameters = request.params,
               .authorization = request.get_header_value("Authorization")});
}

void Answer(const HttpServer::Page& page, bool local_names_only, const httplib::Request& request,
            httplib::Response& response) {
  IgnoreRanges(request);
  HttpResponse answer = AnswerOf(page, local_names_only, request);
  response.status = answer.code;
  if (answer.code == 401) response.set_header("WWW-Authenticate", "Basic realm=\"spikeserve\"");
  response.set_content(answer.body, answer.content_type);
}

// Returns why the server cannot listen on `host`. The library sets errno only once the name is
// resolved.
std::string WhyNot(const std::string& host, int error) {
  addrinfo* found = nullptr;
  const int unresolved = getaddrinfo(host.c_str(), nullptr, nullptr, &found);
  if (unresolved != 0) return ResolveReason(unresolved, host);
  freeaddrinfo(found);
  return ListenReason(error == 0 ? EADDRNOTAVAIL : error);
}

}  // namespace

HttpServer::HttpServer(const TlsFiles& tls, bool local_names_only, Page page)
    : tls_(tls),
      local_names_only_(local_names_only),
      page_(std::move(page)),
      server_(MakeServer(&tls_)) {
  server_->new_task_queue = [] { return new httplib::ThreadPool(kThreads); };  // owned by server_
  server_->set_socket_options(SetSocketOptions);
  server_->set_keep_alive_max_count(1);
  server_->set_keep_alive_timeout(kTimeoutSeconds);
  server_->set_read_timeout(kTimeoutSeconds);
  server_->set_write_timeout(kTimeoutSeconds);
  server_->set_default_headers(PageHeaders());
  server_->set_pre_routing_handler(
      [this](const httplib::Request& request, httplib::Response& response) {
        Answer(page_, local_names_only_, request, response);
        return httplib::Server::HandlerResponse::Handled;
      });
}

absl::StatusOr<std::unique_ptr<HttpServer>> HttpServer::Start(const Address& listen,
                                                              const TlsFiles& tls,
                                                              bool local_names_only, Page page) {
  auto server = std::unique_ptr<HttpServer>(new HttpServer(tls, local_names_only, std::move(page)));
  httplib::Server& http = *server->server_;
  const std::string host(absl::StripSuffix(absl::StripPrefix(listen.host, "["), "]"));
  server->address_ = listen;
  errno = 0;
  if (listen.port == 0) {
    server->address_.port = http.bind_to_any_port(host);
  } else if (!http.bind_to_port(host, listen.port)) {
    server->address_.port = -1;
  }
  if (server->address_.port < 0) {
    return absl::UnavailableError(
        absl::StrCat("cannot listen on ", listen.ToString(), ": ", WhyNot(host, errno)));
  }
  server->listener_ = std::thread([&http] { http.listen_after_bind(); });
  // stop() has no effect before the server runs, so the destructor relies on this wait.
  while (!http.is_running()) absl::SleepFor(absl::Milliseconds(1));
  return server;
}

HttpServer::~HttpServer() {
  if (!listener_.joinable()) return;
  server_->stop();
  listener_.join();
}

}  // namespace spikeserve
