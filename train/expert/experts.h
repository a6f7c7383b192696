// Each environment's experts; `options.environment` is taken for granted, an empty name is the
// first. NOT_FOUND names the experts there are.
#ifndef TRAIN_EXPERT_EXPERTS_H_
#define TRAIN_EXPERT_EXPERTS_H_

#include <memory>

#include "absl/status/statusor.h"
#include "train/expert/expert.h"

namespace spikeserve {

absl::StatusOr<std::unique_ptr<Expert>> MakeCartPoleExpert(const ExpertOptions& options);
absl::StatusOr<std::unique_ptr<Expert>> MakeMountainCarExpert(const ExpertOptions& options);
absl::StatusOr<std::unique_ptr<Expert>> MakePendulumExpert(const ExpertOptions& options);
absl::StatusOr<std::unique_ptr<Expert>> MakeAcrobotExpert(const ExpertOptions& options);

// `expected` says which names there are.
absl::Status UnknownExpert(const ExpertOptions& options, absl::string_view expected);

}  // namespace spikeserve

#endif  // TRAIN_EXPERT_EXPERTS_H_
