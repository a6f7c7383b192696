#include "core/store/redis_tls.h"

#include <openssl/err.h>
#include <openssl/x509_vfy.h>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

struct ContextDeleter {
  void operator()(SSL_CTX* context) const { SSL_CTX_free(context); }
};
using SslContext = std::unique_ptr<SSL_CTX, ContextDeleter>;

absl::Status Refuse(absl::string_view flag, absl::string_view expected, absl::string_view path) {
  return InvalidArgument(flag, expected, absl::StrCat(path, ": ", TakeTlsError()));
}

absl::StatusOr<SslContext> MakeContext(const RedisTlsFiles& files) {
  ERR_clear_error();
  SslContext context(SSL_CTX_new(TLS_client_method()));
  SSL_CTX_set_min_proto_version(context.get(), TLS1_2_VERSION);
  SSL_CTX_set_verify(context.get(), SSL_VERIFY_PEER, nullptr);
  // A file with a password is refused, because there is no terminal to ask on.
  SSL_CTX_set_default_passwd_cb(context.get(), [](char*, int, int, void*) { return 0; });
  const int trusted = files.ca.empty() ? SSL_CTX_set_default_verify_paths(context.get())
                                       : SSL_CTX_load_verify_file(context.get(), files.ca.c_str());
  if (trusted != 1) return Refuse("--store_ca", "a PEM file of authorities", files.ca);
  if (files.certificate.empty()) return context;
  if (SSL_CTX_use_certificate_chain_file(context.get(), files.certificate.c_str()) != 1) {
    return Refuse("--store_certificate", "a PEM file of certificates", files.certificate);
  }
  if (SSL_CTX_use_PrivateKey_file(context.get(), files.key.c_str(), SSL_FILETYPE_PEM) != 1 ||
      SSL_CTX_check_private_key(context.get()) != 1) {
    return Refuse("--store_key", "the PEM key of --store_certificate", files.key);
  }
  return context;
}

}  // namespace

std::string TakeTlsError() {
  const unsigned long code = ERR_get_error();  // NOLINT(google-runtime-int): OpenSSL's type
  ERR_clear_error();
  const char* reason = ERR_reason_error_string(code);
  return reason == nullptr ? "the connection was closed, or there was no answer" : reason;
}

std::string TakeTlsErrorOfWrite(SSL* connection) {
  const std::string reason = TakeTlsError();
  char byte = 0;
  size_t count = 0;
  if (SSL_read_ex(connection, &byte, 1, &count) == 1 || ERR_peek_error() == 0) return reason;
  return TakeTlsError();
}

absl::StatusOr<SslConnection> ConnectTls(int fd, const std::string& host,
                                         const RedisTlsFiles& files) {
  ASSIGN_OR_RETURN(auto context, MakeContext(files));
  SslConnection connection(SSL_new(context.get()));
  SSL_set_fd(connection.get(), fd);
  X509_VERIFY_PARAM* const checked = SSL_get0_param(connection.get());
  if (X509_VERIFY_PARAM_set1_ip_asc(checked, host.c_str()) != 1) {  // a name, then
    SSL_set1_host(connection.get(), host.c_str());
    SSL_set_tlsext_host_name(connection.get(), host.c_str());
  }
  ERR_clear_error();
  if (SSL_connect(connection.get()) == 1) return connection;
  const long verified = SSL_get_verify_result(connection.get());  // NOLINT(google-runtime-int)
  const std::string reason = TakeTlsError();
  return absl::UnavailableError(verified == X509_V_OK ? reason
                                                      : X509_verify_cert_error_string(verified));
}

absl::Status CheckRedisTlsFiles(const RedisTlsFiles& files) { return MakeContext(files).status(); }

}  // namespace spikeserve
