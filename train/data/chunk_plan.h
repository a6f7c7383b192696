// Plans which episodes are in memory at an iteration, for data that are larger than the memory.
//
// A pass over the data draws a new order of the episodes and divides it into chunks that fit into
// the memory. A chunk is used for as many iterations as it takes to draw its number of steps, so a
// pass reads and uses every episode about once. The plan is a function of its arguments.
//
// Not thread-safe. Example:
//   ChunkPlan plan(entries, indices, options);
//   ChunkPlan::Chunk chunk = plan.At(0);   // used up to iteration chunk.end
#pragma once

#include <cstdint>
#include <vector>

#include "train/data/episode_source.h"

namespace spikeserve {

class ChunkPlan {
 public:
  struct Options {
    int64_t memory = 0;               // bytes of a chunk
    int64_t steps_per_iteration = 1;  // drawn from a chunk
    uint64_t seed = 0;
  };

  struct Chunk {
    std::vector<int> episodes;  // indices of entries, ascending
    int64_t begin = 0;          // first iteration that uses it
    int64_t end = 0;            // first iteration after it
  };

  // Plans with the entries of these indices. Keeps a reference to `entries`. REQUIRES: at least one
  // index, and steps_per_iteration of at least 1.
  ChunkPlan(const std::vector<EpisodeEntry>& entries, std::vector<int> episodes, Options options);

  // Returns the chunk of an iteration. An episode that takes more than the memory is a chunk alone.
  // Takes longer if `iteration` is before that of the last call.
  const Chunk& At(int64_t iteration);

 private:
  void BeginPass(uint64_t pass);
  void NextChunk();

  const std::vector<EpisodeEntry>& entries_;
  const std::vector<int> episodes_;
  const Options options_;
  uint64_t pass_ = 0;
  std::vector<int> order_;  // of this pass
  size_t used_ = 0;         // episodes of the pass up to the end of `chunk_`
  Chunk chunk_;
};

}  // namespace spikeserve
