// Stores solved value tables on disk, so that each is solved only once.
//
// The format is a safetensors file with one tensor, `values`, and the table's name in the metadata.
#pragma once

#include <algorithm>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "train/expert/expert.h"
#include "train/expert/value_iteration.h"

namespace spikeserve {

// Reads the values of table `name`. Returns NOT_FOUND if the file does not exist, and
// INVALID_ARGUMENT, with the path, if it holds a table of another name or shape.
absl::StatusOr<std::vector<float>> ReadTable(const std::string& path, const std::string& name,
                                             const std::vector<int>& shape);

// Writes the values of table `name`; creates the directory if it does not exist. REQUIRES: `values`
// has as many elements as `shape`. Returns UNAVAILABLE if the directory cannot be created.
absl::Status WriteTable(const std::vector<float>& values, const std::string& path,
                        const std::string& name, const std::vector<int>& shape);

// Returns the value table over `axes`, coarsened by options.coarsening. Reads it from
// options.tables_directory if it is there; otherwise solves it and writes it there. `name`
// identifies the table in that directory.
template <int D>
absl::StatusOr<ValueTable<D>> LoadOrSolve(const ExpertOptions& options, const std::string& name,
                                          const Problem& problem, Axes<D> axes,
                                          SolveOptions solve) {
  // Every solution starts from the same coarsest grid. An even coarser grid may miss the only state
  // in which a pendulum rests, and then nothing bounds the undiscounted cost.
  solve.coarsest = std::max(1, solve.coarsest / options.coarsening);
  std::vector<int> shape;
  for (Axis& axis : axes) shape.push_back((axis = axis.Coarser(options.coarsening)).points);
  if (options.tables_directory.empty()) return SolveValueTable<D>(problem, axes, solve);
  const std::string path = absl::StrCat(options.tables_directory, "/", name,
                                        options.coarsening == 1 ? "" : "-coarse", ".safetensors");
  absl::StatusOr<std::vector<float>> values = ReadTable(path, name, shape);
  if (values.ok()) return ValueTable<D>{Grid<D>(axes), *std::move(values)};
  if (!absl::IsNotFound(values.status())) return values.status();
  ValueTable<D> table = SolveValueTable<D>(problem, axes, solve);
  if (auto status = WriteTable(table.values, path, name, shape); !status.ok()) return status;
  return table;
}

}  // namespace spikeserve
