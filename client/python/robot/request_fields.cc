#include "client/python/robot/request_fields.h"

#include <span>

namespace spikeserve::robot {
namespace {

namespace nb = nanobind;

nb::list ListOf(std::span<const float> values) {
  nb::list list;
  for (const float value : values) list.append(value);
  return list;
}

nb::dict ActionFields(const ActionView& action, const ActionShape& shape) {
  nb::dict fields;
  if (shape.is_box()) {
    nb::dict continuous;
    continuous["values"] = ListOf(action.continuous);
    fields["continuous"] = continuous;
  } else {
    fields["discrete"] = action.discrete;
  }
  return fields;
}

nb::dict SourceFields(const ChooserView& chooser) {
  nb::dict fields;
  fields["kind"] = static_cast<int>(chooser.kind);
  if (!chooser.operator_id.empty()) {
    fields["operator_id"] = nb::str(chooser.operator_id.data(), chooser.operator_id.size());
  }
  return fields;
}

nb::dict ReportFields(const Report& report) {
  nb::dict fields;
  const Counts& counts = *report.counts;
  for (size_t i = 0; i < kSources; ++i) {
    fields[SourceName(static_cast<Source>(i)).data()] = counts.by_source[i];
  }
  fields["late_answers"] = counts.late_answers;
  fields["cancelled_calls"] = counts.cancelled_requests;
  fields["reconnects"] = counts.reconnects;
  fields["invalid_observations"] = counts.invalid_observations;
  fields["longest_gap_seconds"] = SecondsOf(report.longest_gap);
  fields["oldest_age_seconds"] = SecondsOf(report.oldest_age);
  return fields;
}

nb::dict StepFields(const StepLog& log, const Episode& episode, uint64_t number) {
  const StepView step = log.StepOf(episode, number);
  nb::dict fields;
  fields["step"] = number - episode.first;
  fields["observation"] = ListOf(step.observation);
  fields["reward"] = step.reward;
  fields["executed"] = ActionFields(step.executed, log.shape());
  fields["source"] = SourceFields(step.chooser);
  return fields;
}

}  // namespace

nb::dict FieldsOf(const StepLog& log, const Request& request) {
  nb::dict fields;
  fields["step"] = request.step();
  fields["decision"] = request.decision;
  nb::list history, skipped;
  for (uint64_t number = request.begin; number < request.end; ++number) {
    history.append(StepFields(log, *request.episode, number));
  }
  for (uint64_t number = request.skipped; number < request.begin; ++number) {
    skipped.append(log.RewardOf(number));
  }
  fields["history"] = history;
  fields["skipped_rewards"] = skipped;
  if (request.report.has_value()) fields["report"] = ReportFields(*request.report);
  if (request.ends) fields["end_episode"] = EndFieldsOf(log);
  if (!request.asks) return fields;
  const StepView step = log.At(request.end);
  fields["observation"] = ListOf(step.observation);
  fields["reward"] = step.reward;
  fields["observed_at"] = request.observed_at.count();
  fields["traceparent"] = nb::str(request.traceparent.data(), request.traceparent.size());
  return fields;
}

nb::dict EndFieldsOf(const StepLog& log) {
  const Episode& episode = log.oldest();
  const Outcome& outcome = episode.outcome;
  nb::dict fields;
  fields["reward"] = outcome.reward;
  fields["terminated"] = outcome.terminated;
  fields["truncated"] = outcome.truncated;
  if (outcome.target_return.has_value()) fields["target_return"] = *outcome.target_return;
  fields["observation"] = ListOf(outcome.observation);
  fields["executed_action"] = ActionFields(episode.last.back().executed.view(), log.shape());
  fields["executed_source"] = SourceFields(episode.last.back().chooser.view());
  fields["episode"] = episode.index;
  fields["steps"] = episode.steps;
  return fields;
}

}  // namespace spikeserve::robot
