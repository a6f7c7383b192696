#include "train/trainer/device.h"

#include <ATen/Parallel.h>
#include <dlfcn.h>
#include <torch/cuda.h>

#include <cstdio>
#include <string>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/strip.h"
#include "core/base/status.h"

namespace spikeserve {
namespace {

// Returns a function of OpenBLAS; null if libtorch has another library for linear algebra.
template <typename F>
F* OpenBlas(const char* name) {
  return reinterpret_cast<F*>(dlsym(RTLD_DEFAULT, name));
}

}  // namespace

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

void UseThreads(int count) {
  at::set_num_threads(count);
  if (const auto set = OpenBlas<void(int)>("openblas_set_num_threads")) set(count);
}

void AdviseOnKernels() {
#if defined(__x86_64__)
  const auto name = OpenBlas<const char*()>("openblas_get_corename");
  if (name != nullptr && absl::string_view(name()) == "Prescott" &&
      __builtin_cpu_supports("avx2") != 0) {
    std::fputs(
        "OpenBLAS takes its kernels of 2004 on this processor: with OPENBLAS_CORETYPE=Haswell in "
        "the environment it trains faster\n",
        stderr);
  }
#endif
}

}  // namespace spikeserve
