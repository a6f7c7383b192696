#include "core/dataset/amendments.h"

#include <filesystem>
#include <system_error>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "absl/strings/strip.h"
#include "core/base/file.h"
#include "core/base/json.h"
#include "core/base/json_object.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

namespace fs = std::filesystem;
using Json = nlohmann::json;

std::string AmendmentsPath(absl::string_view path) {
  return absl::StrCat(absl::StripSuffix(path, ".cbor"), ".amendments");
}

absl::StatusOr<EpisodeAmendment> ParseLine(absl::string_view line) {
  ASSIGN_OR_RETURN(const Json json, ParseJsonObject("amendment", line));
  JsonObject object("amendment", json);
  EpisodeAmendment amendment;
  object.Required("amendment_id", &amendment.id);
  object.Required("digest", &amendment.digest);
  object.Required("author", &amendment.author);
  object.Required("time", &amendment.time);
  object.Optional("rewards", &amendment.rewards);
  object.Optional("reward", &amendment.reward);
  object.Optional("success", &amendment.success);
  object.Optional("label", &amendment.label);
  RETURN_IF_ERROR(object.Finish());
  return amendment;
}

}  // namespace

absl::StatusOr<std::vector<EpisodeAmendment>> ReadAmendments(const std::string& path,
                                                             Dataset* dataset) {
  std::vector<EpisodeAmendment> amendments;
  const std::string file = AmendmentsPath(path);
  const auto text = ReadFile(file);
  if (!text.ok()) {
    std::error_code error;
    const bool is_none = fs::status(file, error).type() == fs::file_type::not_found;
    if (is_none) return amendments;
    return text.status();  // the next amendment would replace those that are there
  }
  for (const absl::string_view line : absl::StrSplit(*text, '\n', absl::SkipEmpty())) {
    auto amendment = ParseLine(line);
    if (!amendment.ok()) return Annotate(amendment.status(), file);
    if (auto status = ApplyAmendment(*amendment, dataset); !status.ok()) {
      return Annotate(status, file);
    }
    amendments.push_back(*std::move(amendment));
  }
  return amendments;
}

absl::Status ApplyAmendment(const EpisodeAmendment& amendment, Dataset* dataset) {
  if (dataset->episodes.size() != 1 || !dataset->episodes[0].served.has_value()) {
    return absl::InvalidArgumentError("amendment: expected beside one episode of a server");
  }
  Episode& episode = dataset->episodes[0];
  ServedEpisode& served = *episode.served;
  if (!amendment.rewards.empty() && amendment.rewards.size() != episode.rewards.size()) {
    return InvalidArgument("rewards", absl::StrCat(episode.rewards.size(), " numbers, one a step"),
                           amendment.rewards.size());
  }
  if (amendment.success.has_value()) served.success = amendment.success;
  if (!amendment.label.empty()) served.verdict = amendment.label;
  if (amendment.rewards.empty() && !amendment.reward.has_value()) return absl::OkStatus();
  std::vector<double> received = episode.received_rewards();
  episode.rewards = amendment.rewards.empty() ? received : amendment.rewards;
  episode.rewards.back() += amendment.reward.value_or(0.0);
  served.received_rewards = std::move(received);
  return CheckEpisode(*dataset, episode);
}

std::string AmendmentLine(const EpisodeAmendment& amendment) {
  Json json = {{"amendment_id", amendment.id},
               {"digest", amendment.digest},
               {"author", amendment.author},
               {"time", amendment.time}};
  if (!amendment.rewards.empty()) json["rewards"] = amendment.rewards;
  if (amendment.reward.has_value()) json["reward"] = *amendment.reward;
  if (amendment.success.has_value()) json["success"] = *amendment.success;
  if (!amendment.label.empty()) json["label"] = amendment.label;
  return absl::StrCat(json.dump(), "\n");
}

absl::Status WriteAmendments(const std::string& path,
                             const std::vector<EpisodeAmendment>& amendments) {
  std::string lines;
  for (const EpisodeAmendment& amendment : amendments) {
    absl::StrAppend(&lines, AmendmentLine(amendment));
  }
  return WriteFileAtomically(AmendmentsPath(path), {lines});
}

}  // namespace spikeserve
