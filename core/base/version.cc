#include "core/base/version.h"

namespace spikeserve {

absl::string_view Version() { return SPIKESERVE_VERSION; }

}  // namespace spikeserve
