#include "server/trace/otlp_client.h"

#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <nghttp2/nghttp2.h>
#include <openssl/err.h>
#include <openssl/ssl.h>
#include <openssl/x509v3.h>
#include <poll.h>
#include <sys/socket.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstdint>
#include <cstring>
#include <utility>
#include <vector>

#include "absl/strings/match.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "core/base/clock.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "server/base/file_descriptor.h"

namespace spikeserve {
namespace {

constexpr size_t kPrefixBytes = 5;            // before a message: 0, and its length
constexpr size_t kMostAnswerBytes = 1 << 16;  // of a response, which is practically empty

constexpr unsigned char kAlpn[] = {2, 'h', '2'};

nghttp2_nv Header(absl::string_view name, absl::string_view value) {
  return {.name = reinterpret_cast<uint8_t*>(const_cast<char*>(name.data())),
          .value = reinterpret_cast<uint8_t*>(const_cast<char*>(value.data())),
          .namelen = name.size(),
          .valuelen = value.size(),
          .flags = NGHTTP2_NV_FLAG_NONE};  // nghttp2 copies both
}

std::string Framed(absl::string_view message) {
  std::string framed(1, '\0');
  for (int shift = 24; shift >= 0; shift -= 8) {
    framed.push_back(static_cast<char>(message.size() >> static_cast<unsigned>(shift)));
  }
  framed.append(message.data(), message.size());
  return framed;
}

absl::Status ErrorOfSystem(int error) {
  return absl::UnavailableError(std::strerror(error));  // NOLINT(concurrency-mt-unsafe): glibc's is
}

absl::Status EndedError() { return absl::UnavailableError("the other end closed the connection"); }

absl::Status TlsError(SSL* tls) {
  const char* reason = ERR_reason_error_string(ERR_peek_last_error());
  const int64_t verified = tls == nullptr ? X509_V_OK : SSL_get_verify_result(tls);
  if (verified != X509_V_OK) reason = X509_verify_cert_error_string(verified);
  return absl::UnavailableError(absl::StrCat("TLS: ", reason == nullptr ? "failed" : reason));
}

// A connection to another program over TCP, with or without TLS, for a thread that may wait.
class ClientSocket {
 public:
  // Connects before `end`, a time of SteadyClock, which it may miss by the time that a name takes
  // to resolve. With `tls`, which speaks HTTP/2, checks that the certificate is one of `host`.
  // UNAVAILABLE: the other end cannot be reached or trusted. DEADLINE_EXCEEDED.
  static absl::StatusOr<std::unique_ptr<ClientSocket>> Connect(const std::string& host, int port,
                                                               SSL_CTX* tls, absl::Duration end) {
    std::unique_ptr<ClientSocket> socket(new ClientSocket);
    auto status = socket->ConnectTo(host, port, end);
    if (status.ok() && tls != nullptr) status = socket->StartTls(host, tls, end);
    if (!status.ok()) return status;
    return socket;
  }

  ~ClientSocket() { SSL_free(tls_); }

  // Both return 0 if nothing can be read or written now, and UNAVAILABLE if the connection ended.
  absl::StatusOr<size_t> Read(char* bytes, size_t size) {
    if (tls_ != nullptr) {
      ERR_clear_error();
      const int count = SSL_read(tls_, bytes, static_cast<int>(size));
      return count > 0 ? static_cast<size_t>(count) : TlsResult(count);
    }
    const ssize_t count = recv(socket_.get(), bytes, size, 0);
    if (count > 0) return static_cast<size_t>(count);
    if (count == 0) return EndedError();
    if (errno == EAGAIN || errno == EINTR) return 0;
    return ErrorOfSystem(errno);
  }

  absl::StatusOr<size_t> Write(absl::string_view bytes) {
    if (bytes.empty()) return 0;
    if (tls_ != nullptr) {
      ERR_clear_error();
      const int count = SSL_write(tls_, bytes.data(), static_cast<int>(bytes.size()));
      return count > 0 ? static_cast<size_t>(count) : TlsResult(count);
    }
    const ssize_t count = send(socket_.get(), bytes.data(), bytes.size(), MSG_NOSIGNAL);
    if (count >= 0) return static_cast<size_t>(count);
    if (errno == EAGAIN || errno == EINTR) return 0;
    return ErrorOfSystem(errno);
  }

  // Waits until something may be read, or, if `writes`, written. DEADLINE_EXCEEDED: `end` came.
  absl::Status Wait(bool writes, absl::Duration end) {
    pollfd poller = {.fd = socket_.get(), .events = POLLIN, .revents = 0};
    if (writes || tls_writes_) poller.events |= POLLOUT;
    const absl::Duration left = end - clock_.Now();
    if (left <= absl::ZeroDuration()) return absl::DeadlineExceededError("no answer in time");
    // Looks at the clock again now and then, and never waits for 0 ms with time left.
    const absl::Duration turn = std::min(left, absl::Seconds(1)) + absl::Milliseconds(1);
    poll(&poller, 1, static_cast<int>(absl::ToInt64Milliseconds(turn)));
    if (poller.revents != 0 || clock_.Now() < end) return absl::OkStatus();
    return absl::DeadlineExceededError("no answer in time");
  }

 private:
  ClientSocket() = default;
  absl::Status ConnectTo(const std::string& host, int port, absl::Duration end) {
    addrinfo hints = {};
    hints.ai_socktype = SOCK_STREAM;
    hints.ai_flags = AI_ADDRCONFIG;
    addrinfo* found = nullptr;
    const int error = getaddrinfo(host.c_str(), absl::StrCat(port).c_str(), &hints, &found);
    if (error != 0) return absl::UnavailableError(gai_strerror(error));
    const std::unique_ptr<addrinfo, decltype(&freeaddrinfo)> addresses(found, &freeaddrinfo);
    absl::Status status;
    for (const addrinfo* address = found; address != nullptr; address = address->ai_next) {
      socket_ =
          FileDescriptor(socket(address->ai_family, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0));
      if (!socket_.valid()) return ErrorOfSystem(errno);
      if (connect(socket_.get(), address->ai_addr, address->ai_addrlen) != 0) {
        status = errno == EINPROGRESS ? Wait(/*writes=*/true, end) : ErrorOfSystem(errno);
        int outcome = 0;
        socklen_t length = sizeof(outcome);
        getsockopt(socket_.get(), SOL_SOCKET, SO_ERROR, &outcome, &length);
        if (status.ok() && outcome != 0) status = ErrorOfSystem(outcome);
        if (!status.ok()) continue;
      }
      const int on = 1;
      setsockopt(socket_.get(), IPPROTO_TCP, TCP_NODELAY, &on, sizeof(on));
      return absl::OkStatus();
    }
    return status;
  }

  absl::Status StartTls(const std::string& host, SSL_CTX* tls, absl::Duration end) {
    tls_ = SSL_new(tls);
    if (tls_ == nullptr || SSL_set_fd(tls_, socket_.get()) != 1) return TlsError(nullptr);
    X509_VERIFY_PARAM* const verification = SSL_get0_param(tls_);
    if (X509_VERIFY_PARAM_set1_ip_asc(verification, host.c_str()) != 1) {
      SSL_set_tlsext_host_name(tls_, host.c_str());
      if (SSL_set1_host(tls_, host.c_str()) != 1) return TlsError(nullptr);
    }
    while (true) {
      ERR_clear_error();
      const int result = SSL_connect(tls_);
      if (result == 1) return absl::OkStatus();
      if (const auto waits = TlsResult(result); !waits.ok()) return waits.status();
      RETURN_IF_ERROR(Wait(/*writes=*/false, end));
    }
  }

  // Returns 0 if OpenSSL has to wait, and the error otherwise.
  absl::StatusOr<size_t> TlsResult(int result) {
    switch (SSL_get_error(tls_, result)) {
      case SSL_ERROR_WANT_READ:
        tls_writes_ = false;
        return 0;
      case SSL_ERROR_WANT_WRITE:
        tls_writes_ = true;
        return 0;
      case SSL_ERROR_ZERO_RETURN:
        return EndedError();
      default:
        return TlsError(tls_);
    }
  }

  const SteadyClock clock_ = {};
  FileDescriptor socket_;
  SSL* tls_ = nullptr;       // freed by the destructor
  bool tls_writes_ = false;  // OpenSSL waits until it can write
};

// One call.
struct Exchange {
  std::string request;  // framed
  size_t sent = 0;
  std::string answer = "";
  std::string http_status = "", code = "", message = "";
  bool closed = false;

  // Returns the message of the answer, or the status of the call.
  absl::StatusOr<std::string> Outcome() const {
    int number = 0;
    if (!absl::SimpleAtoi(code, &number)) {
      return absl::UnavailableError(
          absl::StrCat("expected a gRPC status, received HTTP status ", http_status));
    }
    if (number != 0) return absl::Status(static_cast<absl::StatusCode>(number), message);
    if (answer.size() < kPrefixBytes) return absl::InternalError("the answer has no message");
    return answer.substr(kPrefixBytes);
  }
};

// What nghttp2 calls.
struct Callbacks {
  static ssize_t OnSend(nghttp2_session* /*session*/, int32_t /*id*/, uint8_t* out, size_t size,
                        uint32_t* flags, nghttp2_data_source* source, void* /*user*/) {
    auto& exchange = *static_cast<Exchange*>(source->ptr);
    const size_t count = std::min(size, exchange.request.size() - exchange.sent);
    std::memcpy(out, exchange.request.data() + exchange.sent, count);
    exchange.sent += count;
    if (exchange.sent == exchange.request.size()) *flags |= NGHTTP2_DATA_FLAG_EOF;
    return static_cast<ssize_t>(count);
  }

  static Exchange* Find(nghttp2_session* session, int32_t id) {
    return static_cast<Exchange*>(nghttp2_session_get_stream_user_data(session, id));
  }

  static int OnHeader(nghttp2_session* session, const nghttp2_frame* frame, const uint8_t* name,
                      size_t name_length, const uint8_t* value, size_t value_length,
                      uint8_t /*flags*/, void* /*user*/) {
    Exchange* const exchange = Find(session, frame->hd.stream_id);
    if (exchange == nullptr) return 0;
    const absl::string_view key(reinterpret_cast<const char*>(name), name_length);
    const std::string text(reinterpret_cast<const char*>(value), value_length);
    if (key == ":status") exchange->http_status = text;
    if (key == "grpc-status") exchange->code = text;
    if (key == "grpc-message") exchange->message = text;
    return 0;
  }

  static int OnData(nghttp2_session* session, uint8_t /*flags*/, int32_t id, const uint8_t* data,
                    size_t length, void* /*user*/) {
    Exchange* const exchange = Find(session, id);
    if (exchange == nullptr) return 0;
    if (exchange->answer.size() + length > kMostAnswerBytes) return NGHTTP2_ERR_CALLBACK_FAILURE;
    exchange->answer.append(reinterpret_cast<const char*>(data), length);
    return 0;
  }

  static int OnClose(nghttp2_session* session, int32_t id, uint32_t error, void* /*user*/) {
    Exchange* const exchange = Find(session, id);
    if (exchange == nullptr) return 0;
    exchange->closed = true;
    if (exchange->code.empty() && error != 0) {
      exchange->code = absl::StrCat(static_cast<int>(absl::StatusCode::kUnavailable));
      exchange->message = absl::StrCat("the stream was reset: ", nghttp2_http2_strerror(error));
    }
    return 0;
  }
};

class Http2Client final : public OtlpClient {
 public:
  explicit Http2Client(const TraceOptions& options) : options_(options) {}
  ~Http2Client() override { Disconnect(); }

  // INVALID_ARGUMENT: a file of TLS cannot be used.
  absl::Status ReadFiles() {
    if (!options_.tls) return absl::OkStatus();
    tls_ = std::shared_ptr<SSL_CTX>(SSL_CTX_new(TLS_client_method()), &SSL_CTX_free);
    SSL_CTX* const tls = tls_.get();
    SSL_CTX_set_min_proto_version(tls, TLS1_2_VERSION);
    SSL_CTX_set_verify(tls, SSL_VERIFY_PEER, nullptr);
    SSL_CTX_set_mode(tls, SSL_MODE_ENABLE_PARTIAL_WRITE | SSL_MODE_ACCEPT_MOVING_WRITE_BUFFER);
    SSL_CTX_set_alpn_protos(tls, kAlpn, sizeof(kAlpn));
    const auto refuse = [](const char* name, const char* expected, const std::string& file) {
      return InvalidArgument(absl::StrCat("OTEL_EXPORTER_OTLP_", name), expected, file);
    };
    if (options_.ca.empty()) {
      SSL_CTX_set_default_verify_paths(tls);
    } else if (SSL_CTX_load_verify_locations(tls, options_.ca.c_str(), nullptr) != 1) {
      return refuse("CERTIFICATE", "a file of PEM certificates", options_.ca);
    }
    if (options_.certificate.empty()) return absl::OkStatus();
    if (SSL_CTX_use_certificate_chain_file(tls, options_.certificate.c_str()) != 1) {
      return refuse("CLIENT_CERTIFICATE", "a PEM certificate", options_.certificate);
    }
    if (SSL_CTX_use_PrivateKey_file(tls, options_.key.c_str(), SSL_FILETYPE_PEM) != 1) {
      return refuse("CLIENT_KEY", "the PEM private key of the certificate", options_.key);
    }
    return absl::OkStatus();
  }

  absl::StatusOr<std::string> Call(absl::string_view path, absl::string_view message,
                                   absl::Duration timeout) override {
    const absl::Duration end = clock_.Now() + timeout;
    const bool was_connected = socket_ != nullptr;
    auto response = CallOnce(path, message, end);
    // A connection that was kept may have ended unnoticed.
    if (was_connected && socket_ == nullptr && absl::IsUnavailable(response.status())) {
      response = CallOnce(path, message, end);
    }
    if (response.ok()) return response;
    return absl::Status(response.status().code(),
                        absl::StrCat("collector ", options_.host, ":", options_.port, ": ",
                                     response.status().message()));
  }

 private:
  absl::Status Connect(absl::Duration end) {
    Disconnect();
    ASSIGN_OR_RETURN(socket_, ClientSocket::Connect(options_.host, options_.port, tls_.get(), end));
    nghttp2_session_callbacks* callbacks = nullptr;
    nghttp2_session_callbacks_new(&callbacks);
    nghttp2_session_callbacks_set_on_header_callback(callbacks, &Callbacks::OnHeader);
    nghttp2_session_callbacks_set_on_data_chunk_recv_callback(callbacks, &Callbacks::OnData);
    nghttp2_session_callbacks_set_on_stream_close_callback(callbacks, &Callbacks::OnClose);
    nghttp2_session_client_new(&session_, callbacks, nullptr);
    nghttp2_session_callbacks_del(callbacks);
    const nghttp2_settings_entry no_push = {NGHTTP2_SETTINGS_ENABLE_PUSH, 0};
    nghttp2_submit_settings(session_, NGHTTP2_FLAG_NONE, &no_push, 1);
    return absl::OkStatus();
  }

  void Disconnect() {
    nghttp2_session_del(std::exchange(session_, nullptr));
    socket_ = nullptr;
    unsent_.clear();
  }

  absl::StatusOr<std::string> CallOnce(absl::string_view path, absl::string_view message,
                                       absl::Duration end) {
    if (session_ == nullptr || nghttp2_session_check_request_allowed(session_) == 0) {
      RETURN_IF_ERROR(Connect(end));
    }
    Exchange exchange = {.request = Framed(message)};
    auto status = Submit(path, &exchange);
    if (status.ok()) status = Run(exchange, end);
    if (!status.ok()) {
      Disconnect();  // it refers to `exchange`
      return status;
    }
    return exchange.Outcome();
  }

  absl::Status Submit(absl::string_view path, Exchange* exchange) {
    const std::string authority =
        absl::StrCat(absl::StrContains(options_.host, ':') ? absl::StrCat("[", options_.host, "]")
                                                           : options_.host,
                     ":", options_.port);
    const std::string timeout = absl::StrCat(absl::ToInt64Milliseconds(options_.timeout), "m");
    std::vector<nghttp2_nv> headers = {Header(":method", "POST"),
                                       Header(":scheme", options_.tls ? "https" : "http"),
                                       Header(":path", path),
                                       Header(":authority", authority),
                                       Header("te", "trailers"),
                                       Header("content-type", "application/grpc"),
                                       Header("user-agent", "spikeserve"),
                                       Header("grpc-timeout", timeout)};
    for (const auto& [name, value] : options_.headers) headers.push_back(Header(name, value));
    const nghttp2_data_provider data = {.source = {.ptr = exchange},
                                        .read_callback = &Callbacks::OnSend};
    const int id =
        nghttp2_submit_request(session_, nullptr, headers.data(), headers.size(), &data, exchange);
    if (id < 0) return absl::UnavailableError(nghttp2_strerror(id));
    return absl::OkStatus();
  }

  // Sends and receives until the call is over.
  absl::Status Run(const Exchange& exchange, absl::Duration end) {
    while (true) {
      RETURN_IF_ERROR(Flush());
      if (exchange.closed) return absl::OkStatus();
      RETURN_IF_ERROR(socket_->Wait(/*writes=*/!unsent_.empty(), end));
      if (auto status = Receive(); !status.ok()) {
        // The answer may have come before the connection ended.
        return exchange.closed ? absl::OkStatus() : status;
      }
    }
  }

  absl::Status Flush() {
    while (true) {
      if (unsent_.empty()) {
        const uint8_t* data = nullptr;
        const ssize_t length = nghttp2_session_mem_send(session_, &data);
        if (length < 0) return absl::UnavailableError(nghttp2_strerror(static_cast<int>(length)));
        if (length == 0) return absl::OkStatus();
        unsent_.assign(reinterpret_cast<const char*>(data), static_cast<size_t>(length));
      }
      ASSIGN_OR_RETURN(const auto written, socket_->Write(unsent_));
      if (written == 0) return absl::OkStatus();
      unsent_.erase(0, written);
    }
  }

  absl::Status Receive() {
    std::array<char, 16384> buffer;
    while (true) {
      ASSIGN_OR_RETURN(const auto count, socket_->Read(buffer.data(), buffer.size()));
      if (count == 0) return absl::OkStatus();
      const ssize_t taken = nghttp2_session_mem_recv(
          session_, reinterpret_cast<const uint8_t*>(buffer.data()), count);
      if (taken < 0) return absl::UnavailableError(nghttp2_strerror(static_cast<int>(taken)));
    }
  }

  const TraceOptions options_;
  const SteadyClock clock_;
  std::shared_ptr<SSL_CTX> tls_;  // null: none
  std::unique_ptr<ClientSocket> socket_;
  nghttp2_session* session_ = nullptr;  // of `socket_`
  std::string unsent_;
};

}  // namespace

absl::StatusOr<std::unique_ptr<OtlpClient>> OtlpClient::Create(const TraceOptions& options) {
  auto client = std::make_unique<Http2Client>(options);
  RETURN_IF_ERROR(client->ReadFiles());
  return client;
}

}  // namespace spikeserve
