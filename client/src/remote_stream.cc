#include "spikeserve/remote_stream.h"

#include <algorithm>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/time/clock.h"
#include "client/src/item_status.h"
#include "client/src/open_requests.h"
#include "client/src/replicas.h"
#include "client/src/steady_time.h"
#include "client/src/stream_call.h"
#include "spikeserve/client.h"
#include "spikeserve/remote_session.h"

namespace spikeserve {

RemoteStream::RemoteStream(Client* client, std::shared_ptr<Route> route)
    : client_(client), route_(std::move(route)), open_(std::make_unique<OpenRequests>()) {
  client_->replicas_->KeepWithStream(*route_);
  absl::MutexLock lock(&mutex_);
  Start();
}

RemoteStream::~RemoteStream() = default;

absl::Status RemoteStream::Send(RemoteSession* session, absl::Span<const float> observation,
                                double reward,
                                const std::optional<ExecutedAction>& executed_action) {
  absl::MutexLock lock(&mutex_);
  if (open_->Has(session->session_id())) {
    return absl::InvalidArgumentError(absl::StrCat(
        "session ", session->session_id(), ": expected no request under way, received one"));
  }
  const Replica* home =
      session->route_ == nullptr ? nullptr : client_->replicas_->PinnedTo(*session->route_);
  if (home != nullptr && home != replica_) {
    return absl::InvalidArgumentError(absl::StrCat(
        "session: expected one that is stored, or opened with the route of the stream, at ",
        replica_->address, ", received one at ", home->address));
  }
  if (home == nullptr) session->route_ = route_;
  return Send(session, session->MakeRequest(observation, reward, executed_action));
}

absl::Status RemoteStream::Send(const v1::ActRequest& request) {
  absl::MutexLock lock(&mutex_);
  return Send(nullptr, request);
}

absl::Status RemoteStream::Send(RemoteSession* session, v1::ActRequest request) {
  if (send_closed_) return absl::FailedPreconditionError("the stream is closed for sending");
  if (broken_.has_value()) {
    if (!MayReopen()) return *broken_;
    Start();
  }
  if (!reopens_at_.has_value()) {
    const absl::Status sent = call_->Send(request);
    // If the call has ended, Receive opens another one.
    if (!sent.ok() && !MayReopen()) return sent;
  }
  open_->Add({session, std::move(request), std::nullopt});
  return absl::OkStatus();
}

void RemoteStream::CloseSend() {
  absl::MutexLock lock(&mutex_);
  send_closed_ = true;
  call_->CloseSend();
}

bool RemoteStream::MayReopen() const {
  const RetryOptions& retry = client_->options().retry;
  return retry.max_attempts != 1 && retry.max_elapsed > absl::ZeroDuration();
}

void RemoteStream::Start() {
  broken_.reset();
  reopens_at_.reset();
  replica_ = client_->replicas_->Choose(*route_);
  call_ = std::make_shared<StreamCall>(&replica_->connection, *route_);
  // A call that ends meanwhile has a status, which Receive finds.
  StreamCall& call = *call_;
  open_->SendAll([&call](const v1::ActRequest& request) { (void)call.Send(request); });
  if (send_closed_) call_->CloseSend();
}

void RemoteStream::Break(const absl::Status& error) {
  client_->replicas_->Failed(*replica_);
  if (!schedule_.has_value()) schedule_.emplace(client_->options().retry, route_->key);
  const auto delay = open_->empty() ? std::nullopt : schedule_->DelayAfter(error);
  if (delay.has_value()) {
    reopens_at_ = SteadyNow() + *delay;
    return;
  }
  broken_ = error;
  schedule_.reset();
  open_->Clear();
}

absl::Duration RemoteStream::Advance(absl::Duration deadline) {
  const absl::Duration now = SteadyNow();
  if (reopens_at_.has_value()) {
    if (now < *reopens_at_) return std::min(deadline, *reopens_at_);
    Start();
  }
  StreamCall& call = *call_;
  open_->SendDue(now, [&call](const v1::ActRequest& request) { (void)call.Send(request); });
  const absl::Duration asked = open_->waits_since();
  if (now >= std::max(asked, doubted_) + kLineSilence) {
    doubted_ = now;
    replica_->connection.Doubt(asked);
  }
  const absl::Duration until =
      std::min({deadline, open_->next_due(), std::max(asked, doubted_) + kLineSilence});
  if (!client_->replicas_->MayMove(*route_)) return until;
  return std::min(until, asked + client_->options().call_timeout);
}

absl::Status RemoteStream::TakeEnd(const absl::Status& end) {
  if (absl::IsOutOfRange(end) && send_closed_ && open_->empty()) return end;
  // A proxy cancels the streams of a server that has ended.
  const bool is_cut = absl::IsOutOfRange(end) || absl::IsCancelled(end);
  Break(is_cut ? absl::UnavailableError("the server ended the stream") : end);
  return absl::OkStatus();
}

bool RemoteStream::Postpone(const absl::Status& error, OpenRequest* request) {
  if (!IsRetryable(error) && !IsRefusedForNow(error)) return false;
  if (!request->schedule.has_value()) {
    request->schedule.emplace(client_->options().retry, request->request.session_id());
  }
  const auto delay = request->schedule->DelayAfter(error);
  if (!delay.has_value()) return false;
  const bool is_elsewhere =
      IsRetryable(error) && ++request->failures > 1 && client_->replicas_->MayMove(*route_);
  open_->Postpone(std::move(*request), SteadyNow() + *delay);
  if (is_elsewhere) Break(error);
  return true;
}

absl::StatusOr<ActReply> RemoteStream::Receive(absl::Duration timeout) {
  const absl::Duration deadline = SteadyNow() + timeout;
  while (true) {
    std::shared_ptr<StreamCall> call;
    absl::Duration until;
    {
      absl::MutexLock lock(&mutex_);
      if (broken_.has_value()) return *broken_;
      until = Advance(deadline);
      if (!reopens_at_.has_value()) call = call_;
    }
    std::optional<absl::StatusOr<StreamCall::Incoming>> incoming;
    if (call != nullptr) {
      incoming = call->Receive(until);
    } else {
      absl::SleepFor(until - SteadyNow());
    }
    absl::ReleasableMutexLock lock(&mutex_);
    if (incoming.has_value() && call != call_) continue;  // of a call that was given up meanwhile
    if (!incoming.has_value()) {
      const absl::Duration now = SteadyNow();
      const bool is_silent = call != nullptr && call == call_ &&
                             client_->replicas_->MayMove(*route_) &&
                             now >= open_->waits_since() + client_->options().call_timeout;
      if (is_silent) Break(absl::DeadlineExceededError("no answer in time"));
      if (now < deadline) continue;
      return absl::DeadlineExceededError("no reply within " + absl::FormatDuration(timeout));
    }
    if (!incoming->ok()) {
      if (absl::Status ended = TakeEnd(incoming->status()); !ended.ok()) return ended;
      continue;
    }
    v1::ActRequest find;
    auto reply = TakeResponse(std::move((*incoming)->response), (*incoming)->arrived, &find);
    if (!reply.has_value()) continue;
    lock.Release();
    // A call outside of the stream finds the session, or brings its server up to date.
    if (!find.session_id().empty()) (*reply)->response = (*reply)->session->Decide(find);
    return *std::move(reply);
  }
}

std::optional<absl::StatusOr<ActReply>> RemoteStream::TakeResponse(
    v1::ActResponse response, std::chrono::steady_clock::time_point arrived, v1::ActRequest* find) {
  auto request = open_->Take(response.session_id());
  if (!request.has_value() && response.session_id().empty() && !response.has_error()) {
    // A server names the session. A proxy that has lost its server ends the stream with a page.
    Break(absl::UnavailableError("the stream has ended with an empty message"));
    return std::nullopt;
  }
  if (!request.has_value()) {
    return absl::InternalError(absl::StrCat(
        "session_id: expected one with a request under way, received ", response.session_id()));
  }
  schedule_.reset();
  replica_->connection.Answered();
  client_->replicas_->Answered(*route_, *replica_);
  RemoteSession* session = request->session;
  ActReply reply = {.session_id = response.session_id(),
                    .step = response.step(),
                    .response = v1::ActResponse(),
                    .arrived = arrived,
                    .session = session};
  if (response.has_error()) {
    reply.response = StatusOfItem(response.error());
    const absl::Status& error = reply.response.status();
    if (session == nullptr) return reply;
    if (Postpone(error, &*request)) return std::nullopt;
    if (IsSessionLost(error) || ExpectedDecision(error).has_value()) {
      *find = std::move(request->request);
    }
    return reply;
  }
  reply.response = std::move(response);
  if (session != nullptr) {
    absl::Status accepted = session->Accept(*reply.response);
    if (accepted.ok()) {
      session->ToRobot(&*reply.response);
    } else {
      reply.response = std::move(accepted);
    }
  }
  return reply;
}

}  // namespace spikeserve
