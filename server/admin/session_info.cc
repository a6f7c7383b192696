#include "server/admin/session_info.h"

#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "server/messages/convert.h"
#include "server/messages/step_convert.h"

namespace spikeserve {

void ToProto(const ListedSession& listed, v1::SessionInfo* info) {
  absl::MutexLock lock(&listed.entry->mutex);
  const Session& session = listed.entry->agent.session();
  info->set_session_id(listed.id);
  info->set_policy(session.options.policy);
  info->set_version(session.options.version);
  info->set_tenant(session.options.tenant);
  info->set_episode(session.episode);
  info->set_step(session.step);
  info->set_episode_return(session.episode_return);
  info->set_decisions(session.decisions);
  info->set_spikes(session.spikes);
  info->set_energy_joules(session.energy_joules);
  info->set_idle_seconds(absl::ToDoubleSeconds(listed.idle));
  info->set_learning(session.options.learning.has_value());
  info->set_head_drift(listed.entry->agent.HeadDrift());
  info->set_durability(ToProto(session.options.durability));
  if (const auto& journal = listed.entry->journal; journal != nullptr) {
    info->set_epoch(journal->epoch());
    info->set_durable_decision(journal->durable_decisions());
  }
  const SessionEntry& entry = *listed.entry;
  if (entry.period > absl::ZeroDuration()) {
    info->set_period_seconds(absl::ToDoubleSeconds(entry.period));
    info->set_silent(IsSilent(entry.period, listed.idle));
  }
  if (const auto& report = listed.entry->robot.report(); report.has_value()) {
    ToProto(*report, info->mutable_beats());
  }
  if (const auto& hold = listed.entry->agent.hold(); hold != nullptr) {
    ToProto(*hold, info->mutable_hold());
  }
  if (const Help help = listed.entry->agent.NeedsHelp(); help.is_needed()) {
    v1::NeedsHelp& needs_help = *info->mutable_needs_help();
    needs_help.set_score(help.score());
    needs_help.set_unusual_observations(help.unusual_observations);
    needs_help.set_entropy(help.entropy);
    needs_help.set_low_return(help.low_return);
    needs_help.set_fallbacks(help.fallbacks);
  }
  if (session.learner.has_value() && session.learner->corrections.steps > 0) {
    ToProto(session.learner->corrections, info->mutable_corrections());
  }
  info->set_at_neutral(listed.entry->agent.is_at_neutral());
  if (const Seat* seat = listed.entry->agent.seat()) info->set_operator_id(seat->operator_id);
  info->mutable_labels()->insert(session.options.labels.begin(), session.options.labels.end());
}

}  // namespace spikeserve
