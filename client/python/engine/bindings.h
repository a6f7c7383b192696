// The parts of the Python module. Each function adds its classes.
#pragma once

#include <nanobind/nanobind.h>

#include "client/python/engine/batch_answers.h"
#include "client/python/engine/played_policy.h"
#include "core/model/policy.h"
#include "core/session/session.h"

namespace spikeserve {

// A decision as Python sees it.
struct BoundDecision {
  Answer answer;
  bool discrete = false;  // the action space of the policy
  ModelConfig config;     // of the policy
};

// The decisions of one act_batch.
struct BoundBatch {
  BatchAnswers answers;
  bool discrete = false;
  ModelConfig config;
};

BoundDecision ToBound(Answer answer, const Policy& policy);

// Discrete, Box, Stats, Decision, Batch, LearningSummary, EpisodeSummary and SessionState.
void BindValues(nanobind::module_& module);
// Token, SpikeRaster, Attention, RoutingGates and Explanation.
void BindExplanation(nanobind::module_& module);
// Session and Engine.
void BindEngine(nanobind::module_& module);

// Converts an explanation to its Python object.
nanobind::object ToPython(LocalSession::Explained explained, const Policy& policy);
// Returns a Discrete or a Box.
nanobind::object ToPython(const ActionSpace& space);
// Returns the SessionState of a session.
nanobind::object StateOf(LocalSession& session);

}  // namespace spikeserve
