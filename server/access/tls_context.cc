#include "server/access/tls_context.h"

#include <openssl/err.h>
#include <openssl/ssl.h>

#include <algorithm>

#include "core/base/file.h"

namespace spikeserve {
namespace {

constexpr absl::Duration kLookInterval = absl::Seconds(2);

// The length-prefixed list of protocols that ALPN accepts on a port.
std::string& AcceptedByAlpn(Protocol protocol) {
  static std::string http1 = "\x08http/1.1";
  static std::string http2 = "\x02h2";
  return protocol == Protocol::kHttp1 ? http1 : http2;
}

int SelectProtocol(SSL* /*connection*/, const unsigned char** selected, unsigned char* length,
                   const unsigned char* offered, unsigned offered_length, void* accepted_list) {
  const auto& accepted = *static_cast<const std::string*>(accepted_list);
  const int found =
      SSL_select_next_proto(const_cast<unsigned char**>(selected), length,
                            reinterpret_cast<const unsigned char*>(accepted.data()),
                            static_cast<unsigned>(accepted.size()), offered, offered_length);
  return found == OPENSSL_NPN_NEGOTIATED ? SSL_TLSEXT_ERR_OK : SSL_TLSEXT_ERR_ALERT_FATAL;
}

// Returns null if a file is invalid.
std::shared_ptr<ssl_ctx_st> MakeContext(const TlsFiles& files, Protocol protocol) {
  const std::shared_ptr<SSL_CTX> context(SSL_CTX_new(TLS_server_method()), &SSL_CTX_free);
  SSL_CTX_set_min_proto_version(context.get(), TLS1_2_VERSION);
  SSL_CTX_set_default_passwd_cb(context.get(), [](char*, int, int, void*) { return 0; });
  // Without resumption, every connection is checked against the current files. Idle connections
  // keep no buffers.
  SSL_CTX_set_session_cache_mode(context.get(), SSL_SESS_CACHE_OFF);
  SSL_CTX_set_options(context.get(), SSL_OP_NO_TICKET | SSL_OP_NO_RENEGOTIATION);
  SSL_CTX_set_num_tickets(context.get(), 0);
  SSL_CTX_set_mode(context.get(), SSL_MODE_RELEASE_BUFFERS | SSL_MODE_ENABLE_PARTIAL_WRITE |
                                      SSL_MODE_ACCEPT_MOVING_WRITE_BUFFER);
  SSL_CTX_set_alpn_select_cb(context.get(), &SelectProtocol, &AcceptedByAlpn(protocol));
  const bool valid =
      SSL_CTX_use_certificate_chain_file(context.get(), files.certificate.c_str()) == 1 &&
      SSL_CTX_use_PrivateKey_file(context.get(), files.key.c_str(), SSL_FILETYPE_PEM) == 1 &&
      SSL_CTX_check_private_key(context.get()) == 1;
  if (!valid) {
    ERR_clear_error();
    return nullptr;
  }
  if (files.client_ca.empty()) return context;
  auto* names = SSL_load_client_CA_file(files.client_ca.c_str());
  if (names == nullptr || SSL_CTX_load_verify_file(context.get(), files.client_ca.c_str()) != 1) {
    sk_X509_NAME_pop_free(names, X509_NAME_free);
    ERR_clear_error();
    return nullptr;
  }
  SSL_CTX_set_client_CA_list(context.get(), names);  // takes ownership of `names`
  SSL_CTX_set_verify(context.get(), SSL_VERIFY_PEER | SSL_VERIFY_FAIL_IF_NO_PEER_CERT, nullptr);
  return context;
}

}  // namespace

absl::StatusOr<std::unique_ptr<TlsContext>> TlsContext::Create(const TlsFiles& files,
                                                               Protocol protocol,
                                                               const Clock* clock) {
  if (auto status = CheckTlsFiles(files); !status.ok()) return status;
  auto shared = std::unique_ptr<TlsContext>(new TlsContext(files, protocol, clock));
  absl::MutexLock lock(&shared->mutex_);
  shared->context_ = MakeContext(files, protocol);
  if (shared->context_ == nullptr) {
    return absl::InvalidArgumentError("--tls_certificate: OpenSSL cannot use " + files.certificate);
  }
  auto contents = shared->ReadFiles();
  if (!contents.ok()) return contents.status();
  shared->contents_ = *std::move(contents);
  shared->looked_ = clock->Now();
  return shared;
}

absl::StatusOr<std::vector<std::string>> TlsContext::ReadFiles() const {
  std::vector<std::string> contents;
  for (const std::string* path : {&files_.certificate, &files_.key, &files_.client_ca}) {
    if (path->empty()) continue;
    auto content = ReadFile(*path);
    if (!content.ok()) return content.status();
    contents.push_back(*std::move(content));
  }
  return contents;
}

std::shared_ptr<ssl_ctx_st> TlsContext::Get() {
  absl::MutexLock lock(&mutex_);
  const absl::Duration now = clock_->Now();
  if (now - looked_ < kLookInterval) return context_;
  looked_ = now;
  auto contents = ReadFiles();
  if (!contents.ok() || *contents == contents_) return context_;
  contents_ = *std::move(contents);
  if (auto context = MakeContext(files_, protocol_)) context_ = std::move(context);
  return context_;
}

}  // namespace spikeserve
