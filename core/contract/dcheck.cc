#include "core/contract/dcheck.h"

#include <cstdio>
#include <cstdlib>

namespace spikeserve {

void FailDCheck(absl::string_view file, int line, absl::string_view expression,
                absl::string_view details) {
  const std::string message = absl::StrCat(file, ":", line, ": check failed: ", expression,
                                           details.empty() ? "" : " ", details, "\n");
  std::fwrite(message.data(), 1, message.size(), stderr);
  std::abort();
}

}  // namespace spikeserve
