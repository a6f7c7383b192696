// Sequences of requests of agents for several sessions: steps, counts and returns-to-go follow a
// model, errors change nothing, and nothing is decided twice.
#include <array>
#include <cmath>
#include <optional>

#include "absl/strings/str_cat.h"
#include "google/protobuf/message.h"
#include "tests/fuzz/fuzzed_server.h"

namespace spikeserve {
namespace {

enum class Kind {
  kOpen,
  kNext,
  kRetry,
  kBatch,
  kAnyStep,
  kEnd,
  kEndAgain,
  kClose,
  kIdle,
  kBytes,
  kCount
};

constexpr int kSlots = 8;  // more than the store admits

std::string IdOf(int slot) {
  std::string id(32, '0');
  id.back() = static_cast<char>('0' + slot);
  return id;
}

// What a session must have counted, and what it has answered.
struct Model {
  double target = 0.0;
  int64_t episode = 0;
  int64_t step = 0;
  uint64_t decisions = 0;
  double episode_return = 0.0;
  std::optional<v1::ActResponse> answer = std::nullopt;  // absent: unknown
  std::optional<v1::EndEpisodeResponse> end =
      std::nullopt;  // of the episode before, until the next decision
};

// Answers are compared without the time that they took.
std::string BytesOf(v1::ActResponse answer) {
  answer.mutable_stats()->clear_compute_seconds();
  return answer.SerializeAsString();
}

// Returns the part of an input that sends a message with Kind::kBytes.
std::string AsBytes(char method, const google::protobuf::Message& message) {
  const std::string bytes = message.SerializeAsString();
  const char head[] = {static_cast<char>(Kind::kBytes), method, static_cast<char>(bytes.size())};
  return absl::StrCat(absl::string_view(head, sizeof(head)), bytes);
}

class Game {
 public:
  void Apply(Kind kind, InputReader* reader) {
    const uint8_t argument = reader->Byte();
    const int slot = argument % kSlots;
    switch (kind) {
      case Kind::kOpen:
        return Open(slot, argument / kSlots);
      case Kind::kNext:
        return Act(slot, NextStep(slot), reader->Byte());
      case Kind::kRetry:
        return Act(slot, NextStep(slot) - 1, reader->Byte());
      case Kind::kAnyStep:
        return Act(slot, int64_t{reader->Byte()} - 128, argument);
      case Kind::kBatch:
        return Batch(argument % 40, reader);
      case Kind::kEnd:
      case Kind::kEndAgain:
        return End(slot, reader->Byte(), kind == Kind::kEndAgain);
      case Kind::kClose:
        return Close(slot);
      case Kind::kIdle:
        return Idle(argument);
      case Kind::kBytes:
        return SendBytes(argument, reader->Bytes(reader->Byte()));
      case Kind::kCount:
        return;
    }
  }

  void Check() {
    int64_t open = 0;
    for (int slot = 0; slot < kSlots; ++slot) {
      const auto state = StateOf(slot);
      FUZZ_CHECK(state.has_value() == models_[slot].has_value());
      if (!state.has_value()) continue;
      ++open;
      const Model& model = *models_[slot];
      FUZZ_CHECK(state->episode() == model.episode);
      FUZZ_CHECK(state->step() == model.step);
      FUZZ_CHECK(state->decisions() == model.decisions);
      FUZZ_CHECK(state->episode_return() == model.episode_return);
      FUZZ_CHECK(state->target_return() == model.target);
    }
    FUZZ_CHECK(open == server_.store().size());
  }

 private:
  int64_t NextStep(int slot) const { return models_[slot].has_value() ? models_[slot]->step : 0; }

  std::optional<v1::GetSessionResponse> StateOf(int slot) {
    v1::GetSessionRequest request;
    request.set_session_id(IdOf(slot));
    v1::GetSessionResponse response;
    CallContext context = server_.NewContext();
    if (!server_.handler().GetSession(context, request, &response).ok()) {
      return std::nullopt;
    }
    return response;
  }

  void Open(int slot, int flags) {
    v1::OpenSessionRequest request;
    request.set_session_id(IdOf(slot));
    request.set_policy("small");
    request.set_target_return(20.0);
    if ((flags & 1) != 0) request.set_action_selection(v1::SAMPLE);
    if ((flags & 2) != 0) request.mutable_learning()->set_scope(v1::LearningConfig::SESSION);
    if ((flags & 4) != 0) request.mutable_learning()->set_scope(v1::LearningConfig::FLEET);
    v1::OpenSessionResponse response;
    const bool full = server_.store().size() == FuzzedServer::kMaxSessions;
    CallContext context = server_.NewContext();
    const auto status = server_.handler().OpenSession(context, request, &response);
    if (models_[slot].has_value()) return;  // answered again, or refused, and unchanged
    FUZZ_CHECK(status.ok() == !full);
    if (status.ok()) models_[slot] = Model{.target = 20.0};
  }

  static v1::ActRequest Request(int slot, int64_t step, uint8_t argument) {
    v1::ActRequest request;
    request.set_session_id(IdOf(slot));
    request.set_step(step);
    request.set_reward(argument / 16.0);
    for (const float value : ObservationAt(argument)) request.add_observation(value);
    return request;
  }

  // Checks the outcome of a request for a decision and counts it.
  void Expect(const v1::ActRequest& request, bool ok, const v1::ActResponse& response) {
    const int slot = request.session_id().back() - '0';
    std::optional<Model>& model = models_[slot];
    if (!model.has_value()) return FUZZ_CHECK(!ok);
    if (request.step() != model->step) {
      const bool is_retry = model->step > 0 && request.step() == model->step - 1;
      FUZZ_CHECK(!ok || is_retry);  // a retry with another observation or reward is refused
      if (ok && model->answer.has_value()) FUZZ_CHECK(BytesOf(response) == BytesOf(*model->answer));
      return;
    }
    FUZZ_CHECK(ok);
    if (model->step > 0) model->episode_return += request.reward();
    ++model->step;
    ++model->decisions;
    const double to_go = model->target - model->episode_return;
    FUZZ_CHECK(std::abs(response.return_to_go() - to_go) <= 1e-3 * (1.0 + std::abs(to_go)));
    FUZZ_CHECK(response.step() == request.step());
    FUZZ_CHECK(response.session_id() == request.session_id());
    model->answer = response;
    model->end.reset();
  }

  void Act(int slot, int64_t step, uint8_t argument) {
    const v1::ActRequest request = Request(slot, step, argument);
    v1::ActResponse response;
    DeferredWork deferred;
    CallContext context = server_.NewContext(&deferred);
    const auto status = server_.handler().Act(context, request, &response);
    Expect(request, status.ok(), response);
    if (argument % 2 == 0) deferred.Run();  // it may also never run
  }

  // Sends several requests together, also several for one session.
  void Batch(int items, InputReader* reader) {
    v1::ActBatchRequest request;
    std::array<int64_t, kSlots> steps;
    for (int slot = 0; slot < kSlots; ++slot) steps[slot] = NextStep(slot);
    for (int i = 0; i < items && !reader->empty(); ++i) {
      const uint8_t choice = reader->Byte();
      const int slot = choice % kSlots;
      const bool is_retry = choice >= 224;
      *request.add_requests() = Request(slot, steps[slot] - (is_retry ? 1 : 0), choice);
      if (!is_retry) ++steps[slot];
    }
    FUZZ_CHECK(PolicyHandler::CheckBatch(request).ok());
    v1::ActBatchResponse response;
    DeferredWork deferred;
    CallContext context = server_.NewContext(&deferred);
    StepOutcome progress;
    for (int next = 0; next < request.requests_size();) {
      const int first = next;
      next = server_.handler().ActBatchGroup(context, request, next, &response,
                                             absl::ZeroDuration(), &progress);
      FUZZ_CHECK(next > first);
    }
    FUZZ_CHECK(response.results_size() == request.requests_size());
    for (int i = 0; i < request.requests_size(); ++i) {
      const v1::ActResult& result = response.results(i);
      Expect(request.requests(i), result.code() == 0, result.response());
    }
    deferred.Run();
  }

  void End(int slot, uint8_t argument, bool again) {
    std::optional<Model>& model = models_[slot];
    v1::EndEpisodeRequest request;
    request.set_session_id(IdOf(slot));
    request.set_reward(argument / 16.0);
    request.set_terminated(argument % 2 == 0);
    const int64_t episode = model.has_value() ? model->episode - (again ? 1 : 0) : 0;
    if (argument % 3 == 0) request.set_episode(episode);
    v1::EndEpisodeResponse response;
    CallContext context = server_.NewContext();
    const auto status = server_.handler().EndEpisode(context, request, &response);
    if (!model.has_value()) return FUZZ_CHECK(!status.ok());
    if (model->step == 0) {
      if (!status.ok()) return;
      FUZZ_CHECK(model->episode > 0);
      if (model->end.has_value()) {
        FUZZ_CHECK(response.SerializeAsString() == model->end->SerializeAsString());
      }
      return;
    }
    // The running episode is not the one that the request names.
    if (request.has_episode() && request.episode() != model->episode) {
      return FUZZ_CHECK(!status.ok());
    }
    FUZZ_CHECK(status.ok());
    FUZZ_CHECK(response.steps() == model->step);
    FUZZ_CHECK(response.episode_return() == model->episode_return + request.reward());
    *model = Model{
        .target = model->target, .episode = model->episode + 1, .decisions = model->decisions};
    model->end = response;
  }

  void Close(int slot) {
    v1::CloseSessionRequest request;
    request.set_session_id(IdOf(slot));
    v1::CloseSessionResponse response;
    CallContext context = server_.NewContext();
    const auto status = server_.handler().CloseSession(context, request, &response);
    FUZZ_CHECK(status.ok() == models_[slot].has_value());
    models_[slot].reset();
  }

  void Idle(uint8_t argument) {
    server_.clock().Advance(absl::Seconds(argument));
    server_.store().CompactIdle(absl::Seconds(100));
    if (argument < 200) return;
    server_.store().RemoveIdle(absl::Seconds(200));
    for (int slot = 0; slot < kSlots; ++slot) {
      if (!StateOf(slot).has_value()) models_[slot].reset();
    }
  }

  // Sends any bytes as a request of one of the methods, then takes over what it changed.
  void SendBytes(uint8_t method, absl::string_view bytes) {
    const std::string body(bytes);
    DeferredWork deferred;
    CallContext context = server_.NewContext(&deferred);
    switch (method % 4) {
      case 0:
        Send<v1::OpenSessionRequest, v1::OpenSessionResponse>(
            body, [&](const auto& request, auto* response) {
              return server_.handler().OpenSession(context, request, response);
            });
        break;
      case 1:
        Send<v1::ActRequest, v1::ActResponse>(body, [&](const auto& request, auto* response) {
          return server_.handler().Act(context, request, response);
        });
        break;
      case 2:
        Send<v1::EndEpisodeRequest, v1::EndEpisodeResponse>(
            body, [&](const auto& request, auto* response) {
              return server_.handler().EndEpisode(context, request, response);
            });
        break;
      default:
        Send<v1::ExplainRequest, v1::ExplainResponse>(
            body, [&](const auto& request, auto* response) {
              return server_.handler().Explain(context, request, response);
            });
    }
    deferred.Run();
    CloseStrangers();
    for (int slot = 0; slot < kSlots; ++slot) Adopt(slot);
  }

  template <typename Request, typename Response, typename Call>
  void Send(const std::string& body, Call call) {
    Request request;
    if (!request.ParseFromString(body)) return;
    std::array<std::string, kSlots> before;
    for (int slot = 0; slot < kSlots; ++slot) before[slot] = BytesOfState(slot);
    Response response;
    if (call(request, &response).ok()) return;
    for (int slot = 0; slot < kSlots; ++slot) FUZZ_CHECK(BytesOfState(slot) == before[slot]);
  }

  std::string BytesOfState(int slot) {
    const auto state = StateOf(slot);
    return state.has_value() ? state->SerializeAsString() : std::string();
  }

  // Closes sessions that bytes have opened with other ids.
  void CloseStrangers() {
    const auto all = server_.store().ListAfter("", 100, [](const SessionEntry&) { return true; });
    for (const ListedSession& session : all) {
      const bool ours = session.id.substr(0, 31) == std::string(31, '0') &&
                        session.id.back() >= '0' && session.id.back() < '0' + kSlots;
      if (!ours) FUZZ_CHECK(server_.store().Close(session.id).ok());
    }
  }

  void Adopt(int slot) {
    const auto state = StateOf(slot);
    std::optional<Model>& model = models_[slot];
    if (!state.has_value()) return model.reset();
    if (!model.has_value()) model.emplace();
    // One request makes at most one decision.
    FUZZ_CHECK(state->decisions() - model->decisions <= 1);
    const bool unchanged =
        state->decisions() == model->decisions && state->episode() == model->episode;
    model->target = state->target_return();
    model->episode = state->episode();
    model->step = state->step();
    model->decisions = state->decisions();
    model->episode_return = state->episode_return();
    if (unchanged) return;
    model->answer.reset();
    model->end.reset();
  }

  FuzzedServer server_;
  std::array<std::optional<Model>, kSlots> models_;
};

}  // namespace

void FuzzOne(absl::string_view input) {
  InputReader reader(input);
  Game game;
  for (int i = 0; i < 100 && !reader.empty(); ++i) {
    const auto kind = static_cast<Kind>(reader.Byte() % static_cast<int>(Kind::kCount));
    game.Apply(kind, &reader);
    game.Check();
  }
}

std::vector<std::string> Seeds() {
  // Opens three sessions (frozen, sampled, learning), plays, retries, ends and closes them.
  const std::string opens("\0\0\0\x09\0\x12", 6);
  const std::string plays("\1\0a\1\1b\1\2c\1\0d\2\0e\4\3\x81", 18);
  const std::string batch("\3\7\0\1\2\0\1\2\xe0", 9);
  const std::string ends("\5\0\4\6\0\3\1\0f\5\2\5\7\1\6\0\x0a\1", 17);
  v1::ActRequest act;
  act.set_session_id(IdOf(0));
  act.set_decision(1);
  for (const float value : ObservationAt(1)) act.add_observation(value);
  act.mutable_executed_action()->set_discrete(1);
  const std::string raw_act = AsBytes(/*method=*/1, act);
  v1::OpenSessionRequest open;
  open.set_session_id(IdOf(5));
  open.set_policy("small");
  open.set_temperature(2.0);
  open.mutable_learning()->set_rule("hebbian");
  open.mutable_labels()->insert({"robot", "5"});
  const std::string raw_open = AsBytes(/*method=*/0, open);
  return {absl::StrCat(opens, plays, batch, ends), absl::StrCat(opens, raw_act, plays, raw_act),
          absl::StrCat(raw_open, opens, batch, ends)};
}

}  // namespace spikeserve
