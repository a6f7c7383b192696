// The digest that identifies a policy file.
//
// Pure function; safe to call from many threads.
#ifndef CORE_DIGEST_SHA256_H_
#define CORE_DIGEST_SHA256_H_

#include <string>

#include "absl/strings/string_view.h"

namespace spikeserve {

// Returns the SHA-256 of bytes in hexadecimal.
std::string Sha256Of(absl::string_view bytes);

}  // namespace spikeserve

#endif  // CORE_DIGEST_SHA256_H_
