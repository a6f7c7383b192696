// The flags of a session that an agent opens: every field of OpenSessionRequest and LearningConfig
// that a user decides.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "core/action/action_head.h"
#include "core/action/action_space.h"
#include "core/cli/program.h"
#include "core/learning/learning_options.h"
#include "core/session/durability.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// How a session learns. An absent value is the default of the server.
struct LearningFlags {
  std::optional<Rule> rule;
  std::optional<Modulator> modulator;
  std::optional<double> learning_rate;
  std::optional<double> trace_decay;
  std::optional<double> discount;
  std::optional<double> clip;
  std::optional<double> max_drift;
  std::optional<double> guard_margin;
  std::optional<double> verdict_seconds;
};

struct SessionFlags {
  std::optional<Scope> learn;  // absent: the session does not learn
  LearningFlags learning;
  bool sample = false;
  std::optional<double> temperature;
  std::string version_label;
  std::string routing_key;
  std::vector<std::string> labels;  // KEY=VALUE
  std::string head_delta;           // path of a JSON file; empty: the head of the policy
  bool record = false;
  std::optional<Durability> durability;  // absent: the server's default
};

// Adds the flags of LearningFlags, under a heading that the manual describes.
void AddLearningFlags(Command command, LearningFlags* flags);

// Adds the flags of SessionFlags, those of the learning under headings of their own.
void AddSessionFlags(Command command, SessionFlags* flags);

// Returns the configuration of a session that learns with `flags`.
v1::LearningConfig ToProto(Scope scope, const LearningFlags& flags);

// Returns INVALID_ARGUMENT, which names the flag, if the server would refuse `flags`.
absl::Status CheckLearning(Scope scope, const LearningFlags& flags, const ActionSpace& space,
                           const ActionSelection& selection);

// Adds KEY=VALUE texts to `labels`. Returns INVALID_ARGUMENT, which names `flag`.
absl::Status AddLabels(absl::string_view flag, const std::vector<std::string>& texts,
                       google::protobuf::Map<std::string, std::string>* labels);

// Writes `flags` into `request`. Returns INVALID_ARGUMENT, which names the flag.
absl::Status FillRequest(const SessionFlags& flags, v1::OpenSessionRequest* request);

}  // namespace spikeserve
