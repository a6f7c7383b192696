// The experts of each environment. These functions ignore `options.environment`; an empty
// `options.name` selects the environment's first expert. They return NOT_FOUND, with the known
// names, for an unknown expert.
#pragma once

#include <memory>

#include "absl/status/statusor.h"
#include "train/expert/expert.h"

namespace spikeserve {

absl::StatusOr<std::unique_ptr<Expert>> MakeCartPoleExpert(const ExpertOptions& options);
absl::StatusOr<std::unique_ptr<Expert>> MakeMountainCarExpert(const ExpertOptions& options);
absl::StatusOr<std::unique_ptr<Expert>> MakePendulumExpert(const ExpertOptions& options);
absl::StatusOr<std::unique_ptr<Expert>> MakeAcrobotExpert(const ExpertOptions& options);

// Returns the NOT_FOUND error for an unknown expert name; `expected` lists the known names.
absl::Status UnknownExpert(const ExpertOptions& options, absl::string_view expected);

}  // namespace spikeserve
