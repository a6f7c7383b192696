#include "train/expert/beam_search.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <unordered_set>

#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

using State = Grid<4>::State;

struct Node {
  State state;
  double value;
  int parent;  // index in the previous layer
  int choice;  // that led to this state
};

using Layer = std::vector<Node>;

// Returns the pruning box of a state as one number.
uint64_t BoxOf(const State& state) {
  uint64_t box = 0;
  for (int i = 0; i < 4; ++i) {
    const double side = i < 2 ? kBeamAngleBox : kBeamVelocityBox;
    // 16 bits are enough: every state is fewer than 2^15 boxes away from the origin.
    box = box << 16 | static_cast<uint16_t>(std::lround(state[i] / side));
  }
  return box;
}

// Returns the `width` most valuable nodes, at most one per box.
Layer Prune(Layer candidates, int width) {
  std::sort(candidates.begin(), candidates.end(),
            [](const Node& a, const Node& b) { return a.value > b.value; });
  Layer kept;
  std::unordered_set<uint64_t> boxes;
  for (const Node& node : candidates) {
    if (static_cast<int>(kept.size()) == width) break;
    if (boxes.insert(BoxOf(node.state)).second) kept.push_back(node);
  }
  return kept;
}

// Returns the choices that lead to node `index` of the last layer, followed by `last`.
std::vector<int> PathTo(const std::vector<Layer>& layers, int index, int last) {
  std::vector<int> path = {last};
  for (size_t depth = layers.size(); depth-- > 1; index = layers[depth][index].parent) {
    path.push_back(layers[depth][index].choice);
  }
  std::reverse(path.begin(), path.end());
  return path;
}

}  // namespace

std::vector<int> BeamSearch(const Problem& problem, const ValueTable<4>& table, const State& start,
                            int width, int max_steps) {
  SPIKESERVE_DCHECK_GE(width, 1);
  std::vector<Layer> layers = {{{.state = start, .value = 0.0, .parent = 0, .choice = 0}}};
  for (int step = 0; step < max_steps; ++step) {
    Layer candidates;
    for (size_t i = 0; i < layers.back().size(); ++i) {
      for (size_t choice = 0; choice < problem.choices.size(); ++choice) {
        Node node = {.state = layers.back()[i].state,
                     .value = 0.0,
                     .parent = static_cast<int>(i),
                     .choice = static_cast<int>(choice)};
        problem.model->Advance(problem.choices[choice].action, absl::MakeSpan(node.state));
        if (problem.model->IsTerminal(node.state)) return PathTo(layers, node.parent, node.choice);
        node.value = table(node.state);
        candidates.push_back(node);
      }
    }
    layers.push_back(Prune(std::move(candidates), width));
  }
  return {};
}

}  // namespace spikeserve
