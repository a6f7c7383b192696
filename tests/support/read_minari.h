// Reads all episodes of a dataset in Minari's layout, as training does.
#pragma once

#include <cstdint>
#include <string>
#include <utility>

#include "core/base/status_macros.h"
#include "train/data/minari_reader.h"

namespace spikeserve {

inline absl::StatusOr<Dataset> ReadMinariDataset(const std::string& directory) {
  ASSIGN_OR_RETURN(const MinariEpisodes file, MinariEpisodes::Open(directory));
  ASSIGN_OR_RETURN(auto episodes, file.ReadFrom(/*first=*/0, /*bytes=*/INT64_MAX));
  Dataset dataset = file.header();
  dataset.episodes = std::move(episodes);
  return dataset;
}

}  // namespace spikeserve
