#include "server/access/tls.h"

#include <openssl/bio.h>
#include <openssl/err.h>
#include <openssl/pem.h>
#include <openssl/ssl.h>
#include <openssl/x509.h>
#include <unistd.h>

#include <cerrno>
#include <memory>

#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"

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

// Returns that the file cannot be read, or that its content is not what was expected.
absl::Status NotPem(const char* flag, const std::string& path, const char* expected) {
  ERR_clear_error();
  if (access(path.c_str(), R_OK) != 0) {
    return absl::ErrnoToStatus(errno, absl::StrCat(flag, ": cannot read ", path));
  }
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
  ASSIGN_OR_RETURN(const auto certificate, ReadCertificate("--tls_certificate", files.certificate));
  ASSIGN_OR_RETURN(const auto key, ReadKey(files.key));
  if (X509_check_private_key(certificate.get(), key.get()) != 1) {
    ERR_clear_error();
    return absl::InvalidArgumentError(absl::StrCat("--tls_key: expected the key of ",
                                                   files.certificate, ", received ", files.key));
  }
  if (files.client_ca.empty()) return absl::OkStatus();
  return ReadCertificate("--tls_client_ca", files.client_ca).status();
}

}  // namespace spikeserve
