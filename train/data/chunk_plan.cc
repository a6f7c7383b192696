#include "train/data/chunk_plan.h"

#include <algorithm>
#include <utility>

#include "core/contract/dcheck.h"
#include "core/math/counter_random.h"

namespace spikeserve {
namespace {

constexpr uint64_t kOrder = 14;  // first part of the keys of the random order

}  // namespace

ChunkPlan::ChunkPlan(const std::vector<EpisodeEntry>& entries, std::vector<int> episodes,
                     Options options)
    : entries_(entries), episodes_(std::move(episodes)), options_(options) {
  SPIKESERVE_DCHECK(!episodes_.empty());
  BeginPass(0);
  NextChunk();
}

const ChunkPlan::Chunk& ChunkPlan::At(int64_t iteration) {
  if (iteration < chunk_.begin) {
    chunk_ = Chunk();
    BeginPass(0);
    NextChunk();
  }
  while (iteration >= chunk_.end) NextChunk();
  return chunk_;
}

void ChunkPlan::BeginPass(uint64_t pass) {
  pass_ = pass;
  used_ = 0;
  std::vector<std::pair<uint64_t, int>> keys;
  for (const int episode : episodes_) {
    keys.emplace_back(RandomBits({kOrder, options_.seed, pass, static_cast<uint64_t>(episode)}),
                      episode);
  }
  std::sort(keys.begin(), keys.end());
  order_.clear();
  for (const auto& [key, episode] : keys) order_.push_back(episode);
}

void ChunkPlan::NextChunk() {
  if (used_ == order_.size()) BeginPass(pass_ + 1);
  Chunk next = {.episodes = {}, .begin = chunk_.end, .end = chunk_.end};
  int64_t memory = 0, steps = 0;
  for (; used_ < order_.size(); ++used_) {
    const EpisodeEntry& entry = entries_[order_[used_]];
    if (!next.episodes.empty() && memory + entry.memory > options_.memory) break;
    memory += entry.memory;
    steps += entry.steps;
    next.episodes.push_back(order_[used_]);
  }
  std::sort(next.episodes.begin(), next.episodes.end());
  const int64_t per_iteration = options_.steps_per_iteration;
  next.end += std::max<int64_t>(1, (steps + per_iteration - 1) / per_iteration);
  chunk_ = std::move(next);
}

}  // namespace spikeserve
