// Prints the answers of policy files and of the random policies with every SIMD target: a line
// "FILE|NAME KIND TARGET BYTES" each, the bytes in hexadecimal.
//
// usage: golden_play FILE...
#include <iostream>
#include <string>
#include <vector>

#include "absl/strings/escaping.h"
#include "core/engine/spiking/kernels/targets.h"
#include "tests/golden/golden_play.h"

int main(int argc, char** argv) {
  namespace kernels = spikeserve::kernels;
  std::vector<spikeserve::golden::Subject> subjects = spikeserve::golden::RandomSubjects();
  for (int i = 1; i < argc; ++i) {
    subjects.push_back({argv[i], spikeserve::golden::ReadPolicy(argv[i])});
  }
  for (const auto& [name, policy] : subjects) {
    for (const std::string& target : kernels::SupportedTargets()) {
      if (!kernels::ForceTargetForTest(target)) return 1;
      for (const auto& [kind, kind_name] : spikeserve::golden::kKinds) {
        const std::string answers = spikeserve::golden::PlayGolden(policy, kind);
        std::cout << name << ' ' << kind_name << ' ' << target << ' '
                  << absl::BytesToHexString(answers) << '\n';
      }
    }
  }
}
