// Value tables on disk, so that they are solved once.
//
// A safetensors file with one tensor, `values`, and the table's name in the metadata.
#ifndef TRAIN_EXPERT_TABLE_FILE_H_
#define TRAIN_EXPERT_TABLE_FILE_H_

#include <algorithm>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "train/expert/expert.h"
#include "train/expert/value_iteration.h"

namespace spikeserve {

// NOT_FOUND if there is no such file; INVALID_ARGUMENT, with the path, if it holds another table.
absl::StatusOr<std::vector<float>> ReadTable(const std::string& path, const std::string& name,
                                             const std::vector<int>& shape);

// Makes the directory if need be.
absl::Status WriteTable(const std::vector<float>& values, const std::string& path,
                        const std::string& name, const std::vector<int>& shape);

// The table of `axes`, coarsened as the options ask, read from the options' directory or else
// solved and written there. `name` tells it from others.
template <int D>
absl::StatusOr<ValueTable<D>> LoadOrSolve(const ExpertOptions& options, const std::string& name,
                                          const Problem& problem, Axes<D> axes,
                                          SolveOptions solve) {
  // Every solution starts from the same coarsest grid: a coarser one still may miss the one state
  // in which a pendulum rests, and then nothing bounds its undiscounted cost.
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

#endif  // TRAIN_EXPERT_TABLE_FILE_H_
