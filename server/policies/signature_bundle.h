// Reads bundles of OpenSSF model signing (https://github.com/sigstore/model-transparency), whose
// signature is for a list of files and their digests: an in-toto statement in a DSSE envelope.
//
//   ASSIGN_OR_RETURN(const SignatureBundle bundle, ParseBundle(bytes));
//   if (IsSignedBy(key, bundle.signature, bundle.signed_text)) ... FilesOf(bundle)
//
// Pure functions; safe to call from many threads.
#pragma once

#include <cstddef>
#include <map>
#include <string>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

inline constexpr size_t kMostBundleBytes = size_t{64} << 10;

// As it was received: nothing of it is verified.
struct SignatureBundle {
  std::string signature;
  std::string signed_text;  // that `signature` is for: the pre-authentication encoding of DSSE
  std::string statement;    // JSON
};

// Returns INVALID_ARGUMENT for anything else than a bundle of one signature.
absl::StatusOr<SignatureBundle> ParseBundle(absl::string_view bytes);

// Returns the SHA-256 of each file of the statement, in hexadecimal, by its path in the folder that
// was signed, or "." if a file was. INVALID_ARGUMENT unless it is one of model signing 1.0, with
// digests of whole files.
absl::StatusOr<std::map<std::string, std::string>> FilesOf(const SignatureBundle& bundle);

}  // namespace spikeserve
