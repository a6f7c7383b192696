#include "server/transport/socket.h"

#include <openssl/err.h>
#include <openssl/ssl.h>
#include <openssl/x509.h>
#include <sys/socket.h>

#include <algorithm>
#include <cerrno>
#include <climits>
#include <utility>

namespace spikeserve {
namespace {

// What OpenSSL keeps of a connection, measured with a server full of connections.
constexpr int64_t kTlsBytes = 48 << 10;

bool WouldBlock() { return errno == EAGAIN || errno == EWOULDBLOCK || errno == EINTR; }

class PlainSocket final : public Socket {
 public:
  explicit PlainSocket(FileDescriptor fd) : fd_(std::move(fd)) {}

  int fd() const override { return fd_.get(); }

  Result Read(absl::Span<char> buffer) override {
    const ssize_t count = recv(fd_.get(), buffer.data(), buffer.size(), 0);
    if (count > 0) return {Outcome::kDone, static_cast<size_t>(count)};
    return {count < 0 && WouldBlock() ? Outcome::kBlocked : Outcome::kClosed};
  }

  Result Write(absl::string_view data) override {
    const ssize_t count = send(fd_.get(), data.data(), data.size(), MSG_NOSIGNAL);
    if (count >= 0) return {Outcome::kDone, static_cast<size_t>(count)};
    return {WouldBlock() ? Outcome::kBlocked : Outcome::kClosed};
  }

  void ShutDownWriting() override { shutdown(fd_.get(), SHUT_WR); }

 private:
  const FileDescriptor fd_;
};

class TlsSocket final : public Socket {
 public:
  TlsSocket(FileDescriptor fd, SSL* ssl, Protocol protocol)
      : fd_(std::move(fd)), ssl_(ssl), protocol_(protocol) {}

  int fd() const override { return fd_.get(); }
  int64_t overhead() const override { return kTlsBytes; }
  bool read_waits_for_write() const override { return read_waits_for_write_; }
  bool is_handshaking() const override { return SSL_is_init_finished(ssl_.get()) == 0; }
  bool has_buffered_input() const override { return SSL_pending(ssl_.get()) > 0; }
  std::string peer_subject() const override;

  Result Read(absl::Span<char> buffer) override {
    if (!AgreedOnProtocol()) return {Outcome::kClosed};
    ERR_clear_error();
    const int count = SSL_read(ssl_.get(), buffer.data(), Length(buffer.size()));
    if (count > 0 && !AgreedOnProtocol()) return {Outcome::kClosed};
    const Result result = ToResult(count);
    read_waits_for_write_ = result.outcome == Outcome::kBlocked && SSL_want_write(ssl_.get()) != 0;
    return result;
  }

  Result Write(absl::string_view data) override {
    ERR_clear_error();
    return ToResult(SSL_write(ssl_.get(), data.data(), Length(data.size())));
  }

  void ShutDownWriting() override {
    ERR_clear_error();
    if (SSL_is_init_finished(ssl_.get()) != 0) SSL_shutdown(ssl_.get());
    shutdown(fd_.get(), SHUT_WR);
  }

 private:
  struct Free {
    void operator()(SSL* ssl) const { SSL_free(ssl); }
  };

  static int Length(size_t size) { return static_cast<int>(std::min<size_t>(size, INT_MAX)); }

  // Returns true during the handshake. A client that offers only other protocols fails in the
  // handshake; this finds the client that offers none, which cannot mean HTTP/2.
  bool AgreedOnProtocol() const {
    if (protocol_ == Protocol::kHttp1 || SSL_is_init_finished(ssl_.get()) == 0) return true;
    const unsigned char* protocol = nullptr;
    unsigned length = 0;
    SSL_get0_alpn_selected(ssl_.get(), &protocol, &length);
    return length == 2 && protocol[0] == 'h' && protocol[1] == '2';
  }

  Result ToResult(int count) const {
    if (count > 0) return {Outcome::kDone, static_cast<size_t>(count)};
    const int error = SSL_get_error(ssl_.get(), count);
    const bool blocked = error == SSL_ERROR_WANT_READ || error == SSL_ERROR_WANT_WRITE;
    return {blocked ? Outcome::kBlocked : Outcome::kClosed};
  }

  const FileDescriptor fd_;
  const std::unique_ptr<SSL, Free> ssl_;
  const Protocol protocol_;
  bool read_waits_for_write_ = false;
};

std::string TlsSocket::peer_subject() const {
  const std::unique_ptr<X509, decltype(&X509_free)> certificate(
      SSL_get1_peer_certificate(ssl_.get()), &X509_free);
  if (certificate == nullptr) return "";
  const std::unique_ptr<BIO, decltype(&BIO_free)> text(BIO_new(BIO_s_mem()), &BIO_free);
  if (text == nullptr) return "";
  X509_NAME_print_ex(text.get(), X509_get_subject_name(certificate.get()), 0, XN_FLAG_RFC2253);
  char* bytes = nullptr;
  const long length = BIO_get_mem_data(text.get(), &bytes);
  return std::string(bytes, static_cast<size_t>(length));
}

}  // namespace

std::unique_ptr<Socket> MakePlainSocket(FileDescriptor fd) {
  return std::make_unique<PlainSocket>(std::move(fd));
}

std::unique_ptr<Socket> MakeTlsSocket(FileDescriptor fd, TlsContext* tls) {
  SSL* ssl = SSL_new(tls->Get().get());  // keeps the context alive
  if (ssl == nullptr || SSL_set_fd(ssl, fd.get()) != 1) {
    SSL_free(ssl);
    return nullptr;
  }
  SSL_set_accept_state(ssl);
  return std::make_unique<TlsSocket>(std::move(fd), ssl, tls->protocol());
}

}  // namespace spikeserve
