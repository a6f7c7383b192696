#include "server/access/tls.h"

#include <openssl/bio.h>
#include <openssl/err.h>
#include <openssl/pem.h>
#include <openssl/ssl.h>
#include <openssl/x509.h>

#include <memory>

#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

template <auto kFree>
struct Free {
  template <typename T>
  void operator()(T* object) const {
    kFree(object);
  }
};
using Bio = std::unique_ptr<BIO, Free<BIO_free>>;
using Certificate = std::unique_ptr<X509, Free<X509_free>>;
using Key = std::unique_ptr<EVP_PKEY, Free<EVP_PKEY_free>>;
using Store = std::unique_ptr<X509_STORE, Free<X509_STORE_free>>;

absl::Status NotPem(const char* flag, const std::string& path, const char* expected) {
  ERR_clear_error();
  return absl::InvalidArgumentError(
      absl::StrCat(flag, ": expected ", expected, " in PEM form, received ", path));
}

absl::StatusOr<Certificate> ReadCertificate(const char* flag, const std::string& path) {
  const Bio file(BIO_new_file(path.c_str(), "r"));
  if (file != nullptr) {
    Certificate certificate(PEM_read_bio_X509(file.get(), nullptr, nullptr, nullptr));
    if (certificate != nullptr) return certificate;
  }
  return NotPem(flag, path, "a certificate");
}

absl::StatusOr<Key> ReadKey(const std::string& path) {
  const Bio file(BIO_new_file(path.c_str(), "r"));
  char no_password[] = "";
  if (file != nullptr) {
    Key key(PEM_read_bio_PrivateKey(file.get(), nullptr, nullptr, no_password));
    if (key != nullptr) return key;
  }
  return NotPem("--tls_key", path, "a private key without a password");
}

bool RequireClientCertificate(SSL* connection, const std::string& authorities) {
  const Store store(X509_STORE_new());
  auto* names = SSL_load_client_CA_file(authorities.c_str());
  if (names == nullptr || X509_STORE_load_file(store.get(), authorities.c_str()) != 1) return false;
  SSL_set_client_CA_list(connection, names);  // takes ownership of `names`
  SSL_set1_verify_cert_store(connection, store.get());
  SSL_set_verify(connection, SSL_VERIFY_PEER | SSL_VERIFY_FAIL_IF_NO_PEER_CERT, nullptr);
  return true;
}

// Loads the files into a connection. OpenSSL calls this before each handshake and fails the
// handshake if it returns 0.
int UseFiles(SSL* connection, void* tls_files) {
  const auto& files = *static_cast<const TlsFiles*>(tls_files);
  const bool good =
      SSL_use_certificate_chain_file(connection, files.certificate.c_str()) == 1 &&
      SSL_use_PrivateKey_file(connection, files.key.c_str(), SSL_FILETYPE_PEM) == 1 &&
      SSL_check_private_key(connection) == 1 &&
      (files.client_ca.empty() || RequireClientCertificate(connection, files.client_ca));
  if (!good) ERR_clear_error();
  return good ? 1 : 0;
}

}  // namespace

absl::Status TlsFiles::Validate() const {
  if (certificate.empty() != key.empty()) {
    return absl::InvalidArgumentError(absl::StrCat(
        certificate.empty() ? "--tls_certificate" : "--tls_key", ": expected a file together with ",
        certificate.empty() ? "--tls_key" : "--tls_certificate", ", received none"));
  }
  if (!client_ca.empty() && !enabled()) {
    return absl::InvalidArgumentError(
        "--tls_client_ca: expected it together with --tls_certificate and --tls_key, received "
        "neither of these");
  }
  return absl::OkStatus();
}

absl::Status CheckTlsFiles(const TlsFiles& files) {
  if (!files.enabled()) return absl::OkStatus();
  const auto certificate = ReadCertificate("--tls_certificate", files.certificate);
  if (!certificate.ok()) return certificate.status();
  const auto key = ReadKey(files.key);
  if (!key.ok()) return key.status();
  if (X509_check_private_key(certificate->get(), key->get()) != 1) {
    ERR_clear_error();
    return absl::InvalidArgumentError(absl::StrCat("--tls_key: expected the key of ",
                                                   files.certificate, ", received ", files.key));
  }
  if (files.client_ca.empty()) return absl::OkStatus();
  return ReadCertificate("--tls_client_ca", files.client_ca).status();
}

void SetUpTls(const TlsFiles* files, ssl_ctx_st* context) {
  SSL_CTX_set_min_proto_version(context, TLS1_2_VERSION);
  SSL_CTX_set_default_passwd_cb(context, [](char*, int, int, void*) { return 0; });
  // Without resumption, every connection is checked against the current files.
  SSL_CTX_set_session_cache_mode(context, SSL_SESS_CACHE_OFF);
  SSL_CTX_set_options(context, SSL_OP_NO_TICKET);
  SSL_CTX_set_cert_cb(context, &UseFiles, const_cast<TlsFiles*>(files));
}

}  // namespace spikeserve
