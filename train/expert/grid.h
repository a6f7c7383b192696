// A regular grid over a box of D dimensions, and multilinear interpolation of values stored at its
// points.
//
// Points are numbered in row-major order: the last axis varies fastest. A plain value; const
// members are safe to call from many threads.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>

#include "absl/types/span.h"

namespace spikeserve {

struct Axis {
  double low = 0.0;
  double high = 0.0;
  int points = 0;         // at least 2; both ends are points, except on a periodic axis
  bool periodic = false;  // `high` is the same place as `low` and has no point of its own

  int intervals() const { return periodic ? points : points - 1; }
  double step() const { return (high - low) / intervals(); }

  // Returns the same axis with `factor` times fewer intervals.
  Axis Coarser(int factor) const {
    return {low, high, intervals() / factor + (periodic ? 0 : 1), periodic};
  }
};

template <int D>
using Axes = std::array<Axis, D>;

template <int D>
class Grid {
 public:
  using State = std::array<double, D>;

  explicit Grid(const Axes<D>& axes) : axes_(axes) {
    for (int i = D; i-- > 0; size_ *= static_cast<size_t>(axes[i].points)) {
      stride_[i] = size_;
      inverse_step_[i] = 1.0 / axes[i].step();
    }
  }

  size_t size() const { return size_; }
  const Axes<D>& axes() const { return axes_; }

  // Returns the coordinates of a point.
  State StateAt(size_t point) const {
    State state;
    for (int i = 0; i < D; ++i) {
      state[i] = axes_[i].low + axes_[i].step() * static_cast<double>(point / stride_[i]);
      point %= stride_[i];
    }
    return state;
  }

  // Returns the multilinear interpolation of `values` at `state`, from the 2^D corners of the cell
  // around it. A state outside the box gets the value at the nearest edge. REQUIRES: values is
  // [size()].
  double Interpolate(absl::Span<const float> values, const State& state) const {
    std::array<double, 1 << D> corners;
    std::array<size_t, 1 << D> points = {};
    std::array<double, D> fractions;
    for (int i = 0; i < D; ++i) {
      const auto [below, above, fraction] = Locate(i, state[i]);
      fractions[i] = fraction;
      for (int corner = 0; corner < 1 << D; ++corner) {
        points[corner] += (corner >> i & 1) != 0 ? above : below;
      }
    }
    for (int corner = 0; corner < 1 << D; ++corner) corners[corner] = values[points[corner]];
    for (int i = D; i-- > 0;) {
      for (int corner = 0; corner < 1 << i; ++corner) {
        corners[corner] += fractions[i] * (corners[corner + (1 << i)] - corners[corner]);
      }
    }
    return corners[0];
  }

 private:
  struct Place {
    size_t below;     // index along the axis, multiplied by its stride
    size_t above;     // likewise
    double fraction;  // position between below (0) and above (1)
  };

  Place Locate(int i, double x) const {
    const Axis& axis = axes_[i];
    double offset = (x - axis.low) * inverse_step_[i];
    if (axis.periodic) {
      offset -= axis.points * std::floor(offset / axis.points);
    } else {
      offset = std::clamp(offset, 0.0, static_cast<double>(axis.points - 1));
    }
    const int last = axis.periodic ? axis.points - 1 : axis.points - 2;
    const int below = std::min(static_cast<int>(offset), last);
    const int above = below + 1 == axis.points ? 0 : below + 1;
    return {static_cast<size_t>(below) * stride_[i], static_cast<size_t>(above) * stride_[i],
            offset - below};
  }

  Axes<D> axes_;
  std::array<size_t, D> stride_;
  std::array<double, D> inverse_step_;
  size_t size_ = 1;
};

}  // namespace spikeserve
