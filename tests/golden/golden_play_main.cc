// Prints the answers of policies with every SIMD target: a line "FILE KIND TARGET BYTES" each, the
// bytes in hexadecimal.
//
// usage: golden_play FILE...
#include <iostream>

#include "absl/strings/escaping.h"
#include "core/engine/spiking/kernels/targets.h"
#include "tests/golden/golden_play.h"

int main(int argc, char** argv) {
  namespace kernels = spikeserve::kernels;
  for (int i = 1; i < argc; ++i) {
    for (const std::string& target : kernels::SupportedTargets()) {
      if (!kernels::ForceTargetForTest(target)) return 1;
      for (const auto& [kind, name] : spikeserve::golden::kKinds) {
        const std::string answers = spikeserve::golden::PlayGolden(argv[i], kind);
        std::cout << argv[i] << ' ' << name << ' ' << target << ' '
                  << absl::BytesToHexString(answers) << '\n';
      }
    }
  }
}
