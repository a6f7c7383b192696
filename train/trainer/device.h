// Where a training computes. Free functions, safe to call from many threads.
#pragma once

#include <torch/types.h>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "core/model/config.h"

namespace spikeserve {

// Returns the device with a name: cpu, cuda, or cuda:N. Returns INVALID_ARGUMENT for other names,
// and for a device that this machine or this libtorch does not have.
absl::StatusOr<torch::Device> DeviceNamed(absl::string_view name);

// Returns INVALID_ARGUMENT if this arithmetic can be trained on the processor alone: integers
// compute there exactly what the engines do.
absl::Status CheckDevice(torch::Device device, Arithmetic arithmetic);

}  // namespace spikeserve
