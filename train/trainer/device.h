// Where a training computes. Free functions, safe to call from many threads,
// but UseThreads() only while nothing is computed.
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

// Computes with `count` threads, in OpenBLAS, too, which libtorch leaves with one for each
// processor. On a busy machine these wait for each other many times as long as they work.
void UseThreads(int count);

// Prints to standard error what to set for a faster training, if there is something. OpenBLAS
// before 0.3.25 takes its slowest kernels on processors that are younger than it (its issue 4267).
void AdviseOnKernels();

}  // namespace spikeserve
