#include "server/access/tls_context.h"

#include <openssl/err.h>
#include <openssl/ssl.h>
#include <openssl/x509.h>
#include <openssl/x509_vfy.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <ctime>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/time/clock.h"
#include "core/base/file.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

// The suites of TLS 1.2 that HTTP/2 allows: ephemeral keys, and ciphers that authenticate.
constexpr char kCiphers[] = "ECDHE+AESGCM:ECDHE+CHACHA20";

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

// Returns that the file cannot be read, or that its content is not what was expected.
absl::Status NotPem(const char* flag, const std::string& path, const char* expected) {
  ERR_clear_error();
  if (access(path.c_str(), R_OK) != 0) {
    return absl::ErrnoToStatus(errno, absl::StrCat(flag, ": cannot read ", path));
  }
  return InvalidArgument(flag, absl::StrCat(expected, " in PEM form"), path);
}

// Returns INVALID_ARGUMENT, which names flag and file, if a file has another content than expected
// or the key does not belong to the certificate.
absl::StatusOr<std::shared_ptr<ssl_ctx_st>> MakeContext(const TlsFiles& files, Protocol protocol) {
  const std::shared_ptr<SSL_CTX> context(SSL_CTX_new(TLS_server_method()), &SSL_CTX_free);
  SSL_CTX_set_min_proto_version(context.get(), TLS1_2_VERSION);
  SSL_CTX_set_cipher_list(context.get(), kCiphers);
  SSL_CTX_set_default_passwd_cb(context.get(), [](char*, int, int, void*) { return 0; });
  // Without resumption, every connection is checked against the current files. Idle connections
  // keep no buffers.
  SSL_CTX_set_session_cache_mode(context.get(), SSL_SESS_CACHE_OFF);
  SSL_CTX_set_options(context.get(), SSL_OP_NO_TICKET | SSL_OP_NO_RENEGOTIATION);
  SSL_CTX_set_num_tickets(context.get(), 0);
  SSL_CTX_set_mode(context.get(), SSL_MODE_RELEASE_BUFFERS | SSL_MODE_ENABLE_PARTIAL_WRITE |
                                      SSL_MODE_ACCEPT_MOVING_WRITE_BUFFER);
  SSL_CTX_set_alpn_select_cb(context.get(), &SelectProtocol, &AcceptedByAlpn(protocol));
  if (SSL_CTX_use_certificate_chain_file(context.get(), files.certificate.c_str()) != 1) {
    return NotPem("--tls_certificate", files.certificate, "a certificate");
  }
  const bool is_key =
      SSL_CTX_use_PrivateKey_file(context.get(), files.key.c_str(), SSL_FILETYPE_PEM) == 1;
  if (!is_key && ERR_GET_LIB(ERR_peek_last_error()) != ERR_LIB_X509) {
    return NotPem("--tls_key", files.key, "a private key without a password");
  }
  if (!is_key || SSL_CTX_check_private_key(context.get()) != 1) {
    ERR_clear_error();
    return InvalidArgument("--tls_key", absl::StrCat("the key of ", files.certificate), files.key);
  }
  if (files.client_ca.empty()) return context;
  auto* names = SSL_load_client_CA_file(files.client_ca.c_str());
  if (names == nullptr || SSL_CTX_load_verify_file(context.get(), files.client_ca.c_str()) != 1) {
    sk_X509_NAME_pop_free(names, X509_NAME_free);
    return NotPem("--tls_client_ca", files.client_ca, "a certificate");
  }
  SSL_CTX_set_client_CA_list(context.get(), names);  // takes ownership of `names`
  SSL_CTX_set_verify(context.get(), SSL_VERIFY_PEER | SSL_VERIFY_FAIL_IF_NO_PEER_CERT, nullptr);
  return context;
}

absl::Time ToTime(const ASN1_TIME* time) {
  std::tm parts = {};
  if (ASN1_TIME_to_tm(time, &parts) != 1) return absl::InfinitePast();
  return absl::FromTM(parts, absl::UTCTimeZone());
}

CertificateTimes TimesOf(SSL_CTX* context) {
  CertificateTimes times = {.begin = absl::InfinitePast(),
                            .end = absl::InfiniteFuture(),
                            .client_ca = absl::InfiniteFuture()};
  const auto narrow = [&times](const X509* certificate) {
    times.begin = std::max(times.begin, ToTime(X509_get0_notBefore(certificate)));
    times.end = std::min(times.end, ToTime(X509_get0_notAfter(certificate)));
  };
  if (const X509* leaf = SSL_CTX_get0_certificate(context)) narrow(leaf);
  STACK_OF(X509)* chain = nullptr;
  SSL_CTX_get0_chain_certs(context, &chain);
  for (int i = 0; i < sk_X509_num(chain); ++i) narrow(sk_X509_value(chain, i));
  const auto* objects = X509_STORE_get0_objects(SSL_CTX_get_cert_store(context));
  for (int i = 0; i < sk_X509_OBJECT_num(objects); ++i) {
    const X509* authority = X509_OBJECT_get0_X509(sk_X509_OBJECT_value(objects, i));
    if (authority == nullptr) continue;
    times.client_ca = std::min(times.client_ca, ToTime(X509_get0_notAfter(authority)));
  }
  return times;
}

}  // namespace

absl::Status TlsFiles::Validate() const {
  if (certificate.empty() != key.empty()) {
    return InvalidArgument(certificate.empty() ? "--tls_certificate" : "--tls_key",
                           absl::StrCat("a file together with ",
                                        certificate.empty() ? "--tls_key" : "--tls_certificate"),
                           "none");
  }
  if (!client_ca.empty() && !enabled()) {
    return InvalidArgument("--tls_client_ca", "it together with --tls_certificate and --tls_key",
                           "neither of these");
  }
  return absl::OkStatus();
}

absl::StatusOr<std::unique_ptr<TlsContext>> TlsContext::Create(const TlsFiles& files,
                                                               Protocol protocol) {
  auto shared = std::unique_ptr<TlsContext>(new TlsContext(files, protocol));
  RETURN_IF_ERROR(shared->Reload().status());
  return shared;
}

absl::StatusOr<std::vector<std::string>> TlsContext::ReadFiles() const {
  std::vector<std::string> contents;
  for (const auto& [flag, path] :
       {std::pair("--tls_certificate", &files_.certificate), std::pair("--tls_key", &files_.key),
        std::pair("--tls_client_ca", &files_.client_ca)}) {
    if (path->empty()) continue;
    auto content = ReadFile(*path);
    if (!content.ok()) return NotPem(flag, *path, "a file");
    contents.push_back(*std::move(content));
  }
  return contents;
}

absl::StatusOr<bool> TlsContext::Reload() {
  ASSIGN_OR_RETURN(auto contents, ReadFiles());
  {
    absl::MutexLock lock(&mutex_);
    if (contents == contents_) return false;
  }
  ASSIGN_OR_RETURN(auto context, MakeContext(files_, protocol_));
  const absl::Time now = absl::Now();
  const CertificateTimes times = TimesOf(context.get());
  absl::MutexLock lock(&mutex_);
  if (context_ != nullptr && TimesOf(context_.get()).valid_at(now) && !times.valid_at(now)) {
    return InvalidArgument("--tls_certificate", "a certificate that is valid now",
                           absl::StrCat(files_.certificate, ", valid from ",
                                        absl::FormatTime(times.begin, absl::UTCTimeZone()), " to ",
                                        absl::FormatTime(times.end, absl::UTCTimeZone())));
  }
  context_ = std::move(context);
  contents_ = std::move(contents);
  return true;
}

std::shared_ptr<ssl_ctx_st> TlsContext::Get() const {
  absl::MutexLock lock(&mutex_);
  return context_;
}

CertificateTimes TlsContext::times() const { return TimesOf(Get().get()); }

}  // namespace spikeserve
