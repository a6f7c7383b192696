#include "core/learning/peer_norms.h"

#include <algorithm>
#include <limits>

namespace spikeserve {

void PeerNorms::Add(const std::string& contributor, double norm) {
  if (!(norm > 0.0)) return;
  const auto found = std::find(contributors.begin(), contributors.end(), contributor);
  if (found != contributors.end()) {
    norms.erase(norms.begin() + (found - contributors.begin()));
    contributors.erase(found);
  } else if (contributors.size() == kContributors) {
    norms.erase(norms.begin());
    contributors.erase(contributors.begin());
  }
  contributors.push_back(contributor);
  norms.push_back(norm);
}

double PeerNorms::Limit(const std::string& contributor) const {
  std::vector<double> others;
  for (size_t i = 0; i < norms.size(); ++i) {
    if (contributors[i] != contributor) others.push_back(norms[i]);
  }
  if (others.size() < kOthers) return std::numeric_limits<double>::infinity();
  const auto median = others.begin() + static_cast<std::ptrdiff_t>((others.size() - 1) / 2);
  std::nth_element(others.begin(), median, others.end());
  return kFactor * *median;
}

}  // namespace spikeserve
