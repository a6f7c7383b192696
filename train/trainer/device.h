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

// Prints to standard error what to set for a faster training, if there is something. OpenBLAS
// before 0.3.25 takes its slowest kernels on processors that are younger than it (its issue 4267).
void AdviseOnKernels();

}  // namespace spikeserve
