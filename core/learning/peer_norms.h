// Bounds the length of a contribution to a shared head by what the other contributors contribute.
//
//   PeerNorms norms;
//   norms.Add("a", 0.1);
//   clip = std::min(clip, norms.Limit("b"));
//
// A contributor counts once, with the Frobenius norm of its last contribution, and its own norm
// does not count for its own limit. One contributor, and any minority of them, can therefore not
// raise the limit beyond what the others do.
//
// A plain value.
#pragma once

#include <cstddef>
#include <string>
#include <vector>

namespace spikeserve {

struct PeerNorms {
  // The contributors that are remembered: those who have contributed last.
  static constexpr size_t kContributors = 20;
  // There is no limit before this many others have contributed.
  static constexpr size_t kOthers = 4;
  // A contribution may be this many times as long as the median of the others'.
  static constexpr double kFactor = 10.0;

  std::vector<std::string> contributors;  // in the order of their last contributions
  std::vector<double> norms;              // of `contributors`

  // Remembers the norm of a contribution. Ignores one of zero, which shows nothing about the length
  // of updates.
  void Add(const std::string& contributor, double norm);

  // Returns the largest norm of a contribution, or infinity if too few others have contributed.
  double Limit(const std::string& contributor) const;
};

}  // namespace spikeserve
