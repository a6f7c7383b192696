#include "tests/unit/robot/simulator.h"

#include <gtest/gtest-spi.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cstdint>
#include <functional>
#include <iterator>
#include <map>
#include <random>
#include <sstream>
#include <utility>

#include "core/robot/robot_session.h"
#include "tests/unit/robot/simulated_server.h"

namespace spikeserve::robot {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;

constexpr Time kPeriod = milliseconds(20);
constexpr int64_t kMostActions = 1 << 30;
constexpr int64_t kLocal = kMostActions / 2;  // added to a decision of the engine on the robot
constexpr int64_t kNeutral = kMostActions - 1;
constexpr Time kDenied = seconds(2);  // after which a robot may give a stored session up
constexpr int kFaultEvery = 25;       // control steps, about

class Simulator {
 public:
  Simulator(const Kind& kind, const Plan& plan, const ::testing::TestPartResultArray& failures)
      : kind_(kind),
        plan_(plan),
        failures_(failures),
        random_(plan.seed),
        server_(kind.is_stored),
        robot_({.observation_size = 1,
                .neutral = {.discrete = kNeutral, .continuous = {}},
                .period = kPeriod,
                .oldest = kind.oldest,
                .oldest_held = kind.oldest + kind.hold_steps * kPeriod,
                .hold_steps = kind.hold_steps,
                .most_in_flight = 1 + Draw(16),
                .kept_steps = kind.kept_steps,
                .servers = kind.servers,
                .has_engine = kind.has_engine,
                .shares_head = kind.shares_head,
                .sends_datagrams = kind.sends_datagrams,
                .redundancy = kind.sends_datagrams ? 1 + static_cast<int>(Draw(2)) : 1},
               ActionShape(kMostActions, {}, {}), server_.Open(), Clock()),
        denies_until_(kind.servers, kLongAgo) {
    robot_.OnChannel(kNever);
  }

  void Fly() {
    auto fault = plan_.faults.begin();
    for (int i = 0; i < plan_.steps && failures_.size() == 0; ++i) {
      for (; fault != plan_.faults.end() && fault->step <= i; ++fault) Make(*fault);
      if (is_stored() && Draw(4) > 0) server_.Store(Draw(3));
      Step();
      if (Draw(40) == 0) End();
    }
    Finish();
  }

  void Replay(const std::vector<LinkEvent>& events) {
    Step();
    for (const LinkEvent& event : events) {
      TakeAnswer();
      StepBy(2);
      name_ = event.kinds.front() + " before step " + std::to_string(all_.size());
      for (const std::string& kind : event.kinds) Set(kind, true);
      const size_t before = sources_.size();
      StepBy(event.steps);
      CheckSources({sources_.begin() + static_cast<ptrdiff_t>(before), sources_.end()}, event);
      if (event.ends) {
        End();
        StepBy(2);
      }
      if (event.source == "back") TakeAnswer();
      for (const std::string& kind : event.kinds) Set(kind, false);
      if (failures_.size() > 0) return;
    }
    TakeAnswer();
    End();
    Finish();
  }

  // Ends the flight, and checks what is left of it.
  void Finish() {
    Heal();
    Step();
    End();
    for (int i = 0; i < 2000 && !IsDone() && failures_.size() == 0; ++i) {
      RunUntil(now_ + kPeriod);
      server_.Store(1);
    }
    ASSERT_TRUE(IsDone()) << "the server never got all episodes: link "
                          << static_cast<int>(robot_.link()) << ", call "
                          << static_cast<int>(robot_.call());
    CheckServer();
    CheckSummaries();
    EXPECT_EQ(robot_.counters().counts().unequal_returns, 0);
    // A session that no store has is lost with its server; an old server does not repeat an end.
    if (!is_stored() || kind_.is_old || robot_.step_log().dropped() > 0) return;
    EXPECT_LE(robot_.counters().counts().reopened, losses_) << "a session was given up in vain";
  }

  uint64_t events() const { return events_; }
  uint64_t datagrams() const { return datagrams_; }

 private:
  struct Episode {
    std::vector<KnownStep> steps;
    double end_reward = 0.0;
    int settled = 0;  // how often its summary was ready
    bool is_lost = false;
  };

  struct Event {
    uint64_t line = 0;  // of the stream or the call, whose end makes it void
    enum class What {
      kArrives,
      kReply,
      kCall,
      kStreamEnds,
      kDatagram,
      kDatagramReply
    } what = What::kArrives;
    Message message = {};  // of a reply: the request
    Answer answer = {};
    uint64_t datagram = 0;  // its number
    CallState call = CallState::kNone;
  };

  bool IsDone() const {
    return robot_.link() == LinkState::kOnline && !robot_.step_log().oldest().has_ended();
  }
  size_t Draw(size_t below) { return kind_.is_calm ? below - 1 : random_() % below; }
  double DrawReward() { return static_cast<double>(kind_.is_calm ? all_.size() % 8 : Draw(8)); }
  Now Clock() const { return {now_, now_ + asleep_}; }
  bool is_stored() const { return kind_.is_stored; }
  Time Delay() {
    return milliseconds(1) + Time(static_cast<int64_t>(delay_.count() * Draw(3) / 2));
  }

  // The robot.

  void Step() {
    const Time begin = now_;
    const auto number = static_cast<float>(all_.size());
    // Old servers know no other steps, and of these a server compares no observations.
    const bool sees = Draw(12) > 0 || kind_.is_old || kind_.is_shared;
    const KnownStep step = {.observation = sees ? std::optional(number) : std::nullopt,
                            .reward = DrawReward()};
    const std::vector<float> observation(sees ? 1 : 0, number);
    std::vector<KnownStep>& steps = episodes_.back().steps;
    const ActionView replaced = {.discrete = static_cast<int64_t>(Draw(100))};
    const bool is_replaced = !steps.empty() && Draw(10) == 0;
    const bool is_named = replaced.discrete % 2 == 0;
    if (is_replaced && (is_named || all_.back().executed != replaced.discrete)) {
      choosers_.back() = is_named ? Chooser::kOperator : Chooser::kUnknown;
    }
    if (is_replaced) steps.back().executed = all_.back().executed = replaced.discrete;
    const bool is_step = robot_.BeginStep(
        {.observation = observation,
         .reward = step.reward,
         .executed = is_replaced ? &replaced : nullptr,
         .chooser = {.kind = is_replaced && is_named ? Chooser::kOperator : Chooser::kUnknown}},
        Clock());
    ASSERT_EQ(is_step, sees || !all_.empty());
    if (!is_step) return;
    all_.push_back(step);
    observed_.push_back(Clock().robot);
    steps.push_back(step);
    if (steps.size() == 1) steps.back().reward = 0.0;  // of no action
    all_.back().reward = steps.back().reward;
    RunUntil(now_);
    const Time deadline = begin + kPeriod / 2;
    Choice choice = robot_.Choose(Clock(), deadline);
    while (choice == Choice::kWait) {
      ASSERT_LT(now_, deadline) << "a step waits for longer than it may";
      RunUntil(events_at_.empty() ? deadline : std::min(deadline, events_at_.begin()->first));
      choice = robot_.Choose(Clock(), deadline);
    }
    const ActionView own = {.discrete = kNeutral - 1};
    if (choice == Choice::kOwnAction) robot_.TakeOwn(Draw(4) == 0 ? nullptr : &own);
    const StepResult result = robot_.FinishStep(Clock());
    steps.back().executed = all_.back().executed = result.action.discrete;
    choosers_.push_back(result.chooser.kind);
    sources_.push_back(result.source);
    CheckAction(result, sees);
    RunUntil(begin + kPeriod);
  }

  void CheckAction(const StepResult& result, bool sees) {
    constexpr Chooser kChoosers[] = {Chooser::kPolicy, Chooser::kHeld, Chooser::kLocal,
                                     Chooser::kSafe};
    ASSERT_EQ(result.chooser.kind, kChoosers[static_cast<size_t>(result.source)]);
    const int64_t action = result.action.discrete;
    const uint64_t number = all_.size() - 1;
    const uint64_t first = all_.size() - episodes_.back().steps.size();
    switch (result.source) {
      case Source::kFresh:
        ASSERT_TRUE(sees);
        ASSERT_GE(action, static_cast<int64_t>(std::max(first, next_fresh_))) << "an old answer";
        ASSERT_LE(action, static_cast<int64_t>(number));
        ASSERT_LE(Clock().robot - observed_[static_cast<size_t>(action)], kind_.oldest) << "stale";
        next_fresh_ = static_cast<uint64_t>(action) + 1;
        held_ = 0;
        break;
      case Source::kHeld:
        ASSERT_LE(++held_, kind_.hold_steps);
        ASSERT_LE(observed_.back() - fresh_at_, kind_.oldest + kind_.hold_steps * kPeriod)
            << "held for long";
        break;
      case Source::kLocal:
        ASSERT_TRUE(sees);
        ASSERT_EQ(action, static_cast<int64_t>(number) + kLocal) << "of another step";
        break;
      case Source::kSafe:
        ASSERT_GE(action, kNeutral - 1);
        break;
    }
    if (result.source == Source::kFresh) fresh_at_ = observed_[static_cast<size_t>(action)];
  }

  void End() {
    const double reward = DrawReward();
    const auto serial = robot_.EndEpisode({.reward = reward, .terminated = true}, nullptr);
    // A session that begins with the next step has none of this episode.
    if (!serial.has_value()) return;
    ASSERT_EQ(*serial, episodes_.size() - 1);
    episodes_.back().end_reward = reward;
    episodes_.emplace_back();
    RunUntil(now_);
  }

  // The link.

  void Push(Time at, Event event) { events_at_.emplace(at, std::move(event)); }

  void RunUntil(Time time) {
    Work();
    while (!events_at_.empty() && events_at_.begin()->first <= time) {
      now_ = std::max(now_, events_at_.begin()->first);
      const Event event = std::move(events_at_.begin()->second);
      events_at_.erase(events_at_.begin());
      ++events_;
      Happen(event);
      Work();
    }
    now_ = std::max(now_, time);
    Work();
  }

  void Happen(const Event& event) {
    const bool is_void = event.line != (event.what == Event::What::kCall ? call_ : stream_);
    switch (event.what) {
      case Event::What::kArrives: {  // even if nobody waits for the answer any more
        Answer answer = server_.Act(event.message, kind_.is_old);
        if (!answer.error.has_value() && !is_healed_ && Draw(200) == 0)
          answer.error = RandomError();
        if (denies_until_[at_] > now_) answer.error = NotFound();
        if (is_void) return;
        last_reply_ = std::max(last_reply_, std::max(now_, silent_until_) + Delay());
        return Push(last_reply_, {.line = event.line,
                                  .what = Event::What::kReply,
                                  .message = event.message,
                                  .answer = answer});
      }
      case Event::What::kReply:
        if (!is_void) Receive(event);
        return;
      case Event::What::kCall:
        if (!is_void) EndCall(event);
        return;
      case Event::What::kStreamEnds:
        if (!is_void) robot_.OnStreamEnded(Unavailable());
        return;
      case Event::What::kDatagram: {
        if (event.message.session != server_.session().id) return;  // its key has ended
        Answer answer = server_.Act(event.message, kind_.is_old);
        if (!answer.error.has_value() && Draw(200) == 0) answer.error = Unavailable();
        return Throw(
            {.what = Event::What::kDatagramReply, .answer = answer, .datagram = event.datagram});
      }
      case Event::What::kDatagramReply: {
        Reply reply = event.answer.reply;
        if (event.answer.error.has_value()) reply.error = &*event.answer.error;
        ++datagrams_;
        const Received received = robot_.OnDatagram(event.datagram, reply, Clock());
        if (received.settled.has_value()) Take(*received.settled);
        return;
      }
    }
  }

  // Sends a datagram, which may be lost, doubled or overtaken.
  void Throw(const Event& event) {
    const bool is_second = ++thrown_ % 2 == 0;
    if (IsAway() || now_ < firewall_until_ || Draw(10) == 0 || (loses_ && is_second)) return;
    for (size_t i = 0; i < 1 + (Draw(10) == 0 || doubles_ ? 1U : 0U); ++i) {
      const bool is_late = Draw(10) == 0 || (reorders_ && is_second);
      Push(now_ + Delay() + milliseconds(is_late ? Draw(60) : 0), event);
    }
  }

  void Receive(const Event& event) {
    Reply reply = event.answer.reply;
    const std::optional<Error>& error = event.answer.error;
    if (error.has_value()) {
      reply.error = &*error;
      Deny(*error);
    } else if (event.message.decision - event.message.step ==
               DecisionOf(robot_.step_log().oldest().first)) {
      denied_since_ = kNever;
    }
    if (Draw(4) == 0) reply.episode_return.reset();  // the server does not know it any more
    const Received received = robot_.OnReply(reply, Clock());
    if (received.settled.has_value()) Take(*received.settled);
  }

  uint64_t DecisionOf(uint64_t number) const { return number - robot_.step_log().NumberOf(0); }

  // Counts a session that the robot may give up because servers have denied it for long.
  void Deny(const Error& error) {
    if (error.kind != Failure::kNotFound || error.expected_decision.has_value()) return;
    denied_since_ = std::min(denied_since_, now_);
    if (now_ - denied_since_ >= kDenied) ++losses_;
  }

  void Take(const Settled& settled) {
    Episode& episode = episodes_[settled.serial];
    ++episode.settled;
    ASSERT_EQ(settled.lost_steps + settled.steps, episode.steps.size());
    double rewards = episode.end_reward;
    for (size_t t = settled.lost_steps + 1; t < episode.steps.size(); ++t) {
      rewards += episode.steps[t].reward;
    }
    ASSERT_EQ(settled.episode_return, rewards);
  }

  void Work() {
    for (int i = 0; now_ >= busy_until_; ++i) {
      ASSERT_LT(i, 1000) << "a task is wanted without end";
      const Task task = robot_.Next(now_);
      if (task.kind == Task::Kind::kWait) {
        ASSERT_GT(task.time, now_);
        return;
      }
      Do(task);
      robot_.TakeLines();
    }
  }

  void Do(const Task& task) {
    switch (task.kind) {
      case Task::Kind::kForget:
        ++stream_;
        if (robot_.call() == CallState::kNone) ++call_;
        for (uint64_t i = base_; i < task.serial; ++i) {
          episodes_[i].is_lost = episodes_[i].settled == 0;
        }
        base_ = task.serial;
        return;
      case Task::Kind::kSend:
        CheckRequest(task.request);
        ASSERT_TRUE(task.ways.stream || task.ways.datagram);
        for (int i = 0; task.ways.datagram && i < task.copies; ++i) {
          Throw({.what = Event::What::kDatagram,
                 .message = MessageOf(session_, robot_.step_log(), task.request),
                 .datagram = task.datagram});
        }
        if (!task.ways.stream) return;
        last_request_ = std::max(last_request_, now_ + Delay());
        return Push(last_request_,
                    {.line = stream_,
                     .what = Event::What::kArrives,
                     .message = MessageOf(session_, robot_.step_log(), task.request)});
      case Task::Kind::kPlay:
        return Play();
      case Task::Kind::kOpenStream:
        at_ = 0;
        while (at_ + 1 < kind_.servers && (robot_.HasDenied(at_) || IsAway())) ++at_;
        robot_.OnStreamOpened(at_);
        last_request_ = last_reply_ = now_;
        if (IsAway()) Push(now_ + Delay(), {.line = stream_, .what = Event::What::kStreamEnds});
        return;
      case Task::Kind::kCloseStream:
        ++stream_;
        robot_.OnStreamClosed(is_renewed_, now_);
        is_renewed_ = false;
        return;
      case Task::Kind::kDoubtLine:  // a fresh connection takes the place of a dead one
        if (now_ >= silent_until_) {
          is_renewed_ = true;
          robot_.OnStreamEnded(Unavailable());
        }
        return;
      default:
        Push(now_ + Delay() + Delay(),
             {.line = call_, .what = Event::What::kCall, .call = robot_.call()});
    }
  }

  bool IsAway() const { return now_ < cut_until_; }

  void CheckRequest(const Request& request) {
    ASSERT_LE(request.skipped, request.begin);
    ASSERT_LE(request.begin, request.end);
    ASSERT_GE(request.step(), 0);
    ASSERT_LT(request.step(), static_cast<int64_t>(request.episode->steps + 1));
    for (uint64_t i = request.begin; i < request.end; ++i) {
      const StepView step = robot_.step_log().StepOf(*request.episode, i);
      ASSERT_EQ(step.observation.empty(), !all_[i].observation.has_value());
      ASSERT_EQ(step.executed.discrete, all_[i].executed) << "a history has another action";
      ASSERT_EQ(step.chooser.kind, choosers_[i]) << "a history names another chooser";
    }
  }

  void EndCall(const Event& event) {
    ++call_;
    if (IsAway() || now_ < silent_until_) return robot_.OnCallFailed(Unavailable(), 0, now_);
    const ServedSession& session = server_.session();
    if (event.call == CallState::kOpenSession) {
      const Opening opening = server_.Open();
      session_ = session.id;
      denied_since_ = kNever;
      robot_.OnOpened(opening);
      return robot_.OnChannel(kNever);
    }
    if (session.id != session_ || denies_until_[0] > now_) {
      Deny(NotFound());
      return robot_.OnCallFailed(NotFound(), 0, now_);
    }
    if (event.call == CallState::kExportSession) {
      const bool is_known =
          robot_.OnExported(session.decisions(), static_cast<int64_t>(session.ended.size()),
                            static_cast<int64_t>(session.steps.size()), now_);
      if (is_known) played_.reset();
      if (is_known) denied_since_ = kNever;
      return;
    }
    const uint64_t steps = robot_.step_log().oldest().steps;
    const Answer answer =
        server_.End({.session = session_,
                     .decision = DecisionOf(robot_.step_log().oldest().past()),
                     .step = steps,
                     .end_reward = robot_.step_log().oldest().outcome.reward,
                     .end_steps = steps,
                     .end_executed = robot_.step_log().oldest().last.back().executed.discrete});
    if (answer.error.has_value()) return robot_.OnCallFailed(*answer.error, 0, now_);
    denied_since_ = kNever;
    Take(robot_.OnEpisodeEnded(answer.reply.episode_return));
  }

  // The engine on the robot plays every step once, in order.
  void Play() {
    const LocalWork& work = robot_.work();
    if (Draw(500) == 0) return robot_.OnPlayed(nullptr, "it failed", now_);
    const ActionView action = {.discrete = static_cast<int64_t>(work.number) + kLocal};
    if (!work.is_end) {
      if (played_.has_value()) {
        ASSERT_EQ(work.number, *played_ + 1) << "the engine misses a step";
      }
      ASSERT_EQ(work.observation.empty(), !all_[work.number].observation.has_value());
      ASSERT_EQ(work.reward, all_[work.number].reward);
      played_ = work.number;
    }
    if (work.has_executed) {
      ASSERT_EQ(work.executed.discrete, all_[work.number - 1].executed);
    }
    if (Draw(50) == 0) busy_until_ = now_ + milliseconds(Draw(60));
    robot_.OnPlayed(&action, "", now_);
  }

  // Faults.

  static Error Unavailable() { return {.kind = Failure::kAway, .message = "away", .text = "away"}; }
  static Error NotFound() {
    return {.kind = Failure::kNotFound, .message = "not found", .text = "not found"};
  }
  Error RandomError() {
    const size_t kind = Draw(4);
    losses_ += kind / 2;
    switch (kind) {
      case 0:
        return {.message = "later", .text = "later", .retry_after = milliseconds(Draw(500))};
      case 1:
        return Unavailable();
      case 2:
        return {.kind = Failure::kInvalid, .message = "invalid", .text = "invalid"};
      default:
        return {.kind = Failure::kConflict, .message = "conflict", .text = "conflict"};
    }
  }

  void CutStream() { Push(now_, {.line = stream_, .what = Event::What::kStreamEnds}); }

  void Make(const Fault& fault) {
    std::mt19937_64 random(fault.random);
    const auto time = [&](size_t most) { return milliseconds(random() % most); };
    switch (fault.kind) {
      case Fault::Kind::kReset:  // after which what was sent may arrive
        return CutStream();
      case Fault::Kind::kCut:
        cut_until_ = now_ + time(1500);
        return CutStream();
      case Fault::Kind::kBlackHole:
        silent_until_ = now_ + time(3000);
        return;
      case Fault::Kind::kKill:  // the server loses what its store does not have
        server_.Kill();
        return CutStream();
      case Fault::Kind::kTakeOver:  // as kKill, by another server, while the stream of a proxy
                                    // stays
        server_.Kill();
        return;
      case Fault::Kind::kDelay:
        delay_ = milliseconds(1) + time(random() % 3 == 0 ? 400 : 30);
        return;
      case Fault::Kind::kDeny:  // a server denies the session for a moment
        denies_until_[random() % kind_.servers] = now_ + time(1000);
        if (!is_stored()) ++losses_;
        return;
      case Fault::Kind::kSleep:  // of the robot's computer
        asleep_ += time(20'000);
        return;
      case Fault::Kind::kBusy:  // the background thread gets no time
        busy_until_ = now_ + time(100);
        return;
      case Fault::Kind::kIntruder:  // another robot uses the session's id
        if (server_.Intrude()) ++losses_;
        return;
      case Fault::Kind::kFirewall:  // drops datagrams
        firewall_until_ = now_ + time(3000);
        return;
    }
  }

  // Begins or ends a kind of event.
  void Set(const std::string& kind, bool begins) {
    const Time until = begins ? kNever : kLongAgo;
    if (kind == "loss") loses_ = begins;
    if (kind == "duplicate") doubles_ = begins;
    if (kind == "reorder") reorders_ = begins;
    if (kind == "late") delay_ = milliseconds(begins ? 100 : 2);
    if (kind == "full") is_full_ = begins;
    if (kind == "black-hole" || kind == "suspend") silent_until_ = firewall_until_ = until;
    if (kind == "cut" || kind == "kill") cut_until_ = until;
    if (!begins) return;
    if (kind == "suspend") asleep_ += seconds(60);
    if (kind == "drain") server_.Store(SIZE_MAX);
    if (kind == "take-over" || kind == "fail-over" || kind == "kill" || kind == "drain") {
      server_.Kill();
    }
    if (kind == "lost") server_.Lose();
    losses_ += kind == "lost" ? 1 : 0;
    if (kind == "cut" || kind == "fail-over" || kind == "kill" || kind == "drain") CutStream();
  }

  void StepBy(int steps) {
    for (int i = 0; i < steps && failures_.size() == 0; ++i) {
      if (!is_full_) server_.Store(8);
      Step();
    }
  }

  // Waits for an answer, as a robot that stands still, and takes it.
  void TakeAnswer() {
    for (int i = 0; i < 1000 && next_fresh_ < all_.size() && !robot_.HasAnswer(); ++i) {
      robot_.AskAgain(Clock());
      RunUntil(now_ + kPeriod);
    }
    StepBy(1);
    ASSERT_EQ(sources_.back(), Source::kFresh) << "no answer, " << name_;
  }

  void CheckSources(const std::vector<Source>& sources, const LinkEvent& event) {
    const auto safe = std::ranges::find(sources, Source::kSafe);
    if (event.source == "fresh") {
      EXPECT_EQ(safe, sources.end()) << name_;
    }
    if (event.source != "safe" && event.source != "stale") return;
    ASSERT_NE(safe, sources.end()) << name_;
    EXPECT_EQ(std::count(safe, sources.end(), Source::kSafe), sources.end() - safe) << name_;
    const auto fresh = std::find_if(std::reverse_iterator(safe), sources.rend(),
                                    [](Source source) { return source != Source::kHeld; });
    EXPECT_EQ(safe - fresh.base(), event.source == "safe" ? kind_.hold_steps : 0) << name_;
  }

  void Heal() {
    is_healed_ = true;
    cut_until_ = firewall_until_ = silent_until_ = busy_until_ = kLongAgo;
    delay_ = milliseconds(2);
    denies_until_.assign(kind_.servers, kLongAgo);
    // A request of which no answer will come is given up with its stream.
    CutStream();
  }

  // What is left.

  void CheckServer() {
    const ServedSession& session = server_.session();
    ASSERT_EQ(session.id, session_);
    ASSERT_EQ(base_ + session.ended.size(), episodes_.size() - 1);
    for (size_t i = 0; i < session.ended.size(); ++i) {
      const EndedEpisode& ended = *session.ended[i];
      const Episode& episode = episodes_[base_ + i];
      EXPECT_EQ(ended.end_reward, episode.end_reward);
      // A session that was opened in the middle of an episode may lack its begin.
      ASSERT_LE(ended.steps.size(), episode.steps.size());
      if (i > 0) {
        ASSERT_EQ(ended.steps.size(), episode.steps.size());
      }
      const size_t missing = episode.steps.size() - ended.steps.size();
      for (size_t t = 0; t < ended.steps.size(); ++t) {
        const KnownStep& known = ended.steps[t];
        const KnownStep& step = episode.steps[missing + t];
        ASSERT_EQ(known.reward, step.reward) << "step " << t;
        if (!known.observation.has_value()) {
          ASSERT_TRUE(!step.observation.has_value() || robot_.step_log().dropped() > 0)
              << "step " << t;
          continue;
        }
        ASSERT_EQ(known.observation, step.observation) << "step " << t;
        // In front of a gap, the server need not know what was executed.
        const bool is_last = t + 1 == ended.steps.size();
        if (robot_.step_log().dropped() > 0) continue;
        if (is_last || ended.steps[t + 1].observation.has_value()) {
          ASSERT_EQ(known.executed, step.executed) << "step " << t << " of " << ended.steps.size();
        }
      }
    }
  }

  void CheckSummaries() {
    for (size_t i = 0; i + 1 < episodes_.size(); ++i) {
      EXPECT_NE(episodes_[i].settled > 0, episodes_[i].is_lost) << "episode " << i;
    }
  }

  const Kind kind_;
  const Plan& plan_;
  const ::testing::TestPartResultArray& failures_;
  std::mt19937_64 random_;
  Time now_ = Time::zero();
  Time asleep_ = Time::zero();
  SimulatedServer server_;
  RobotSession robot_;

  std::vector<KnownStep> all_;
  std::vector<Chooser> choosers_;  // of the executed actions of all_
  std::vector<Source> sources_;    // of all_
  std::vector<Time> observed_;     // of all_
  std::vector<Episode> episodes_{1};
  uint64_t base_ = 0;  // serial number of the first episode of the server's session
  uint64_t next_fresh_ = 0;
  Time fresh_at_ = kLongAgo;
  int held_ = 0;

  std::multimap<Time, Event> events_at_;
  uint64_t events_ = 0;
  uint64_t datagrams_ = 0;
  uint64_t session_ = 1;
  uint64_t stream_ = 0;
  uint64_t call_ = 0;
  size_t at_ = 0;  // the server of the stream
  bool is_renewed_ = false;
  Time last_request_ = kLongAgo;  // of the stream; it keeps the order
  Time last_reply_ = kLongAgo;
  std::optional<uint64_t> played_;

  bool is_healed_ = false;  // no faults any more
  uint64_t losses_ = 0;     // faults that cost the session
  Time denied_since_ = kNever;
  Time delay_ = milliseconds(2);
  Time cut_until_ = kLongAgo;
  Time firewall_until_ = kLongAgo;
  Time silent_until_ = kLongAgo;
  Time busy_until_ = kLongAgo;
  uint64_t thrown_ = 0;  // datagrams, of which every second one meets these:
  bool loses_ = false, doubles_ = false, reorders_ = false;
  bool is_full_ = false;  // the store
  std::string name_;      // of the event
  std::vector<Time> denies_until_;
};

// Returns what became of a flight.
Flight Watch(const Kind& kind, const Plan& plan, const std::function<void(Simulator&)>& fly) {
  ::testing::TestPartResultArray failures;
  const ::testing::ScopedFakeTestPartResultReporter reporter(
      ::testing::ScopedFakeTestPartResultReporter::INTERCEPT_ONLY_CURRENT_THREAD, &failures);
  Simulator simulator(kind, plan, failures);
  fly(simulator);
  Flight flight = {.events = simulator.events(), .datagrams = simulator.datagrams()};
  if (failures.size() > 0) {
    std::ostringstream text;
    text << failures.GetTestPartResult(0);
    flight.failure = text.str();
  }
  return flight;
}

}  // namespace

Plan MakePlan(const Kind& kind, uint64_t seed) {
  Plan plan = {.seed = seed};
  std::mt19937_64 random(~seed);
  for (int step = 0; step < plan.steps; ++step) {
    if (random() % kFaultEvery > 0) continue;
    Fault fault = {step, static_cast<Fault::Kind>(random() % Fault::kKinds), random()};
    if (fault.kind == Fault::Kind::kIntruder && !kind.is_shared) continue;
    if (fault.kind == Fault::Kind::kFirewall && !kind.sends_datagrams) continue;
    plan.faults.push_back(fault);
  }
  return plan;
}

Flight Fly(const Kind& kind, const Plan& plan) { return Watch(kind, plan, &Simulator::Fly); }

Flight Replay(const std::vector<LinkEvent>& events) {
  const Kind kind = {.servers = 2,
                     .sends_datagrams = true,
                     .oldest = seconds(30),
                     .hold_steps = 50,
                     .is_calm = true};
  return Watch(kind, {}, [&](Simulator& simulator) { simulator.Replay(events); });
}

}  // namespace spikeserve::robot
