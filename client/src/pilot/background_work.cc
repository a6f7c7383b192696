// The part of Pilot::Controller that talks to the servers.
#include <algorithm>
#include <limits>
#include <set>
#include <utility>

#include "client/src/pilot/controller.h"
#include "client/src/pilot/robot_messages.h"
#include "client/src/steady_time.h"
#include "spikeserve/retry.h"

namespace spikeserve {

using piloting::ErrorOf;
using piloting::FromRobot;
using piloting::ServerCall;
using robot::CallState;
using robot::Task;

namespace {

constexpr absl::Duration kCallTimeout = absl::Seconds(2);  // then the call is made again
constexpr absl::Duration kCloseTimeout = absl::Seconds(1);

robot::Time SteadyTime() { return piloting::ToRobot(SteadyNow()); }

}  // namespace

absl::Status Pilot::Controller::Resume(Client* client) {
  if (options_.local == nullptr) return absl::OkStatus();
  const auto exported =
      client->ExportSession(session_id(), options_.local->NeedsPolicyFile(), route_);
  if (IsRetryable(exported.status())) return absl::OkStatus();
  if (!exported.ok()) return exported.status();
  if (absl::Status status = options_.local->Resume(*exported); !status.ok()) return status;
  absl::MutexLock lock(&mutex_);
  return TakeExported(*exported) ? absl::OkStatus()
                                 : absl::FailedPreconditionError(
                                       "export: expected a new session, received one with steps");
}

void Pilot::Controller::Start() {
  is_started_ = true;
  background_->Add(this);
}

void Pilot::Controller::Close() {
  if (!std::exchange(is_started_, false)) return;
  {
    absl::MutexLock lock(&mutex_);
    session_.Close(SteadyTime() + piloting::ToRobot(options_.close_timeout));
    background_->Wake(this);
  }
  background_->AwaitEnd(this);
  Stop();
}

std::optional<absl::Duration> Pilot::Controller::Work() {
  while (true) {
    Task task;
    v1::ActRequest request;
    std::vector<std::string> lines;
    std::optional<CallState> ended;
    {
      absl::MutexLock lock(&mutex_);
      if (is_call_done_) {
        ended = session_.call();
      } else {
        task = session_.Next(SteadyTime());
      }
      if (task.kind == Task::Kind::kSend) Fill(task.request, &request);
      lines = session_.TakeLines();
    }
    WriteLog(lines);
    if (ended.has_value()) {
      TakeCall(*ended);
    } else if (task.kind == Task::Kind::kWait) {
      return FromRobot(task.time);
    } else if (task.kind == Task::Kind::kStop) {
      return std::nullopt;
    } else {
      Do(task, &request);
    }
  }
}

void Pilot::Controller::Do(const Task& task, v1::ActRequest* request) {
  switch (task.kind) {
    case Task::Kind::kForget:
      return Forget(task);
    case Task::Kind::kSend:
      return Send(task, request);
    case Task::Kind::kPlay:
      return Play();
    case Task::Kind::kOpenSession:
      return OpenSession();
    case Task::Kind::kOpenStream:
      return OpenStream();
    case Task::Kind::kCloseStream:
      return CloseStream();
    case Task::Kind::kDoubtLine:
      return replica_->connection.Doubt(FromRobot(task.time));
    case Task::Kind::kExportSession:
      return ExportSession();
    case Task::Kind::kEndEpisode:
      return CallEndEpisode();
    case Task::Kind::kWait:
    case Task::Kind::kStop:
      return;  // of Work
  }
}

void Pilot::Controller::Send(const Task& task, v1::ActRequest* request) {
  if (task.ways.datagram) datagrams_->Send(task.datagram, *request, task.copies);
  if (task.ways.stream) stream_->Send(std::move(*request));
}

void Pilot::Controller::Fill(const robot::Request& request, v1::ActRequest* message) {
  piloting::ToProto(session_.step_log(), request, message);
  message->set_session_id(session_id_);
  if (message->has_observed_at()) {
    message->set_valid_until(message->observed_at() + piloting::ToRobot(options_.oldest()).count());
  }
}

void Pilot::Controller::WriteLog(const std::vector<std::string>& lines) const {
  if (options_.log == nullptr) return;
  for (const std::string& line : lines) options_.log(line);
}

void Pilot::Controller::Forget(const Task& task) {
  stream_.reset();
  CallState kind;
  {
    absl::MutexLock lock(&mutex_);
    kind = session_.call();
  }
  if (kind == CallState::kNone) call_.reset();
  absl::MutexLock lock(&mutex_);
  if (call_ == nullptr) is_call_done_ = false;  // it may have ended before it was removed
  FailSummaries(task.serial, task.reason);
}

void Pilot::Controller::OpenStream() {
  std::set<const Replica*> denied;
  {
    absl::MutexLock lock(&mutex_);
    for (size_t i = 0; i < servers_.size(); ++i) {
      if (session_.HasDenied(i)) denied.insert(servers_[i]);
    }
  }
  replica_ = replicas_->Choose(*route_, denied);
  {
    absl::MutexLock lock(&mutex_);
    session_.OnStreamOpened(IndexOf(replica_));
  }
  ActionStream::Listener* const listener = this;
  stream_ = std::make_unique<ActionStream>(&replica_->connection, *route_, listener);
}

void Pilot::Controller::CloseStream() {
  const bool is_renewed = stream_->IsRenewed();
  stream_.reset();
  absl::MutexLock lock(&mutex_);
  if (session_.OnStreamClosed(is_renewed, SteadyTime())) replicas_->Failed(*replica_);
}

void Pilot::Controller::OnReply(v1::ActResponse&& reply) {
  const robot::Now now = piloting::ReadClocks();
  robot::Error error;
  const robot::Reply view = piloting::ReplyOf(reply, &error);
  absl::MutexLock lock(&mutex_);
  if (session_.link() == robot::LinkState::kOnline) {
    replica_->connection.Answered();
    replicas_->Answered(*route_, *replica_);
  }
  const robot::Received received = session_.OnReply(view, now);
  Take(received, reply);
}

void Pilot::Controller::OnEnd(const absl::Status& status) {
  absl::MutexLock lock(&mutex_);
  session_.OnStreamEnded(
      ErrorOf(status.ok() ? absl::UnavailableError("the server ended the stream") : status));
  background_->Wake(this);
  has_event_.notify_all();  // nobody waits for answers that are lost
}

void Pilot::Controller::OnDatagram(uint64_t number, const v1::ActResponse& reply) {
  const robot::Now now = piloting::ReadClocks();
  robot::Error error;
  const robot::Reply view = piloting::ReplyOf(reply, &error);
  absl::MutexLock lock(&mutex_);
  const robot::Received received = session_.OnDatagram(number, view, now);
  Take(received, reply);
}

void Pilot::Controller::Take(const robot::Received& received, const v1::ActResponse& reply) {
  if (received.settled.has_value()) Complete(*received.settled, reply.ended());
  if (reply.has_datagrams()) TakeChannel(reply.datagrams());
  if (received.has_work) background_->Wake(this);
  has_event_.notify_all();
}

void Pilot::Controller::TakeChannel(const v1::DatagramChannel& channel) {
  if (datagrams_ == nullptr || !datagrams_->SetChannel(channel).ok()) return;
  session_.OnChannel(SteadyTime() + piloting::ToRobot(absl::Seconds(channel.valid_seconds())));
}

void Pilot::Controller::Play() {
  const robot::LocalWork* work = nullptr;
  {
    absl::MutexLock lock(&mutex_);
    work = &session_.work();
  }
  std::optional<ActionView> executed;
  if (work->has_executed) executed = FromRobot(work->executed.view(), work->chooser.view());
  absl::StatusOr<ActionView> action = ActionView();
  if (work->is_end) {
    const robot::Outcome& outcome = work->outcome;
    const absl::Status status = options_.local->EndEpisode({.reward = outcome.reward,
                                                            .terminated = outcome.terminated,
                                                            .truncated = outcome.truncated,
                                                            .target_return = outcome.target_return,
                                                            .observation = outcome.observation},
                                                           *executed);
    if (!status.ok()) action = status;
  } else {
    action = options_.local->Act(work->step, work->observation, work->reward, executed);
  }
  const robot::ActionView view = piloting::ToRobot(action.value_or(ActionView()));
  absl::MutexLock lock(&mutex_);
  session_.OnPlayed(action.ok() ? &view : nullptr, action.status().ToString(), SteadyTime());
  has_event_.notify_all();
}

ServerCall& Pilot::Controller::NewCall() {
  call_ = std::make_unique<ServerCall>(replicas_, route_.get(), kCallTimeout, [this] {
    absl::MutexLock lock(&mutex_);
    is_call_done_ = true;
    background_->Wake(this);
  });
  return *call_;
}

void Pilot::Controller::OpenSession() {
  replicas_->Pin(*route_, false);
  if (opening_.session_id().empty()) opening_.set_session_id(DrawId());
  NewCall().Begin(&ServerCall::Async::OpenSession, opening_);
}

void Pilot::Controller::ExportSession() {
  v1::ExportSessionRequest request;
  request.set_session_id(session_id());
  request.set_include_policy(options_.local->NeedsPolicyFile());
  NewCall().Begin(&ServerCall::Async::ExportSession, request);
}

void Pilot::Controller::CallEndEpisode() {
  v1::EndEpisodeRequest request;
  {
    absl::MutexLock lock(&mutex_);
    request.set_session_id(session_id_);
    piloting::EndToProto(session_.step_log(), &request);
  }
  NewCall().Begin(&ServerCall::Async::EndEpisode, request);
}

void Pilot::Controller::TakeCall(CallState kind) {
  absl::Status status = call_->Await();
  const std::unique_ptr<ServerCall> call = std::move(call_);
  if (status.ok() && kind == CallState::kOpenSession &&
      call->response<v1::OpenSessionResponse>().history_limit() == 0) {
    status = absl::UnimplementedError("server: expected one that appends beats");
  }
  // An engine takes a moment to read its policy.
  if (status.ok() && kind == CallState::kExportSession) {
    status = options_.local->Resume(call->response<v1::ExportSessionResponse>());
  }
  absl::MutexLock lock(&mutex_);
  is_call_done_ = false;
  if (!status.ok()) {
    session_.OnCallFailed(ErrorOf(status), IndexOf(call->replica()), SteadyTime());
  } else if (kind == CallState::kOpenSession) {
    session_.OnOpened(piloting::OpeningOf(call->response<v1::OpenSessionResponse>()));
    TakeOpened(call->response<v1::OpenSessionResponse>());
  } else if (kind == CallState::kExportSession) {
    TakeExported(call->response<v1::ExportSessionResponse>());
  } else {
    const auto& ended = call->response<v1::EndEpisodeResponse>();
    Complete(session_.OnEpisodeEnded(piloting::ReturnOf(ended)), ended);
  }
}

bool Pilot::Controller::TakeExported(const v1::ExportSessionResponse& exported) {
  return session_.OnExported(exported.decision(), exported.episode(), exported.step(),
                             SteadyTime());
}

void Pilot::Controller::TakeOpened(const v1::OpenSessionResponse& opened) {
  replicas_->Pin(*route_, !piloting::OpeningOf(opened).is_stored);
  opening_.clear_session_id();  // the next session is another one
  session_id_ = opened.session_id();
  if (opened.has_datagrams()) TakeChannel(opened.datagrams());
}

void Pilot::Controller::Stop() {
  bool is_open = false;
  v1::CloseSessionRequest request;
  {
    absl::MutexLock lock(&mutex_);
    is_open = session_.Stop();
    request.set_session_id(session_id_);
  }
  stream_.reset();
  if (datagrams_ != nullptr) datagrams_->Stop();
  call_.reset();
  std::vector<std::string> lines;
  {
    absl::MutexLock lock(&mutex_);
    FailSummaries(std::numeric_limits<uint64_t>::max(), piloting::kClosed);
    lines = session_.TakeLines();
  }
  WriteLog(lines);
  if (!is_open) return;
  ServerCall close(replicas_, route_.get(), kCloseTimeout, [] {});
  close.Begin(&ServerCall::Async::CloseSession, request);
  (void)close.Await();  // a session that is not closed ends by itself
}

void Pilot::Controller::FailSummaries(uint64_t serial, absl::string_view reason) {
  while (!summaries_.empty() && summaries_.begin()->first < serial) {
    summaries_.begin()->second.set_value(piloting::LostEpisode(reason));
    summaries_.erase(summaries_.begin());
  }
}

void Pilot::Controller::Complete(const robot::Settled& settled, v1::EndEpisodeResponse summary) {
  summary.set_episode_return(settled.episode_return);
  summary.set_steps(static_cast<int64_t>(settled.steps));
  summary.set_lost_steps(static_cast<int64_t>(settled.lost_steps));
  const auto found = summaries_.find(settled.serial);
  if (found == summaries_.end()) return;  // answered before, to a server that has lost it
  found->second.set_value(std::move(summary));
  summaries_.erase(found);
}

size_t Pilot::Controller::IndexOf(const Replica* replica) const {
  return static_cast<size_t>(std::find(servers_.begin(), servers_.end(), replica) -
                             servers_.begin());
}

}  // namespace spikeserve
