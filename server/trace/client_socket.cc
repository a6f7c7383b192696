#include "server/trace/client_socket.h"

#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <openssl/err.h>
#include <openssl/ssl.h>
#include <openssl/x509v3.h>
#include <poll.h>
#include <sys/socket.h>

#include <algorithm>
#include <cerrno>
#include <cstring>

#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

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

}  // namespace

absl::StatusOr<std::unique_ptr<ClientSocket>> ClientSocket::Connect(const std::string& host,
                                                                    int port, ssl_ctx_st* tls,
                                                                    absl::Duration end) {
  std::unique_ptr<ClientSocket> socket(new ClientSocket);
  auto status = socket->ConnectTo(host, port, end);
  if (status.ok() && tls != nullptr) status = socket->StartTls(host, tls, end);
  if (!status.ok()) return status;
  return socket;
}

ClientSocket::~ClientSocket() { SSL_free(tls_); }

absl::Status ClientSocket::ConnectTo(const std::string& host, int port, absl::Duration end) {
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

absl::Status ClientSocket::StartTls(const std::string& host, ssl_ctx_st* tls, absl::Duration end) {
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

absl::StatusOr<size_t> ClientSocket::TlsResult(int result) {
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

absl::StatusOr<size_t> ClientSocket::Read(char* bytes, size_t size) {
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

absl::StatusOr<size_t> ClientSocket::Write(absl::string_view bytes) {
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

absl::Status ClientSocket::Wait(bool writes, absl::Duration end) {
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

}  // namespace spikeserve
