#include "train/trainer/device.h"

#include <torch/cuda.h>

#include <string>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/strip.h"
#include "core/base/status.h"

namespace spikeserve {

absl::StatusOr<torch::Device> DeviceNamed(absl::string_view name) {
  if (name == "cpu") return torch::Device(torch::kCPU);
  absl::string_view rest = name;
  int index = 0;
  const bool is_cuda = absl::ConsumePrefix(&rest, "cuda") &&
                       (rest.empty() || (absl::ConsumePrefix(&rest, ":") && !rest.empty() &&
                                         absl::SimpleAtoi(rest, &index) && index >= 0));
  if (!is_cuda) {
    return InvalidArgument("--device", "cpu, cuda or cuda:N", name);
  }
  const auto devices = static_cast<int>(torch::cuda::device_count());
  if (devices == 0) {
    return InvalidArgument("--device", "cpu, as libtorch finds no CUDA device here", name);
  }
  if (index >= devices) {
    return InvalidArgument("--device", absl::StrCat("cuda:0 to cuda:", devices - 1), name);
  }
  return torch::Device(torch::kCUDA, static_cast<torch::DeviceIndex>(index));
}

absl::Status CheckDevice(torch::Device device, Arithmetic arithmetic) {
  if (device.is_cpu()) return absl::OkStatus();
  if (arithmetic != Arithmetic::kFloat32) {
    return InvalidArgument(
        "--device", absl::StrCat("cpu with --arithmetic=", std::string(ToString(arithmetic))),
        device.str());
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
