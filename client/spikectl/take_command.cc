#include <poll.h>
#include <termios.h>
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <iostream>
#include <memory>
#include <string>
#include <string_view>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/time/clock.h"
#include "client/spikectl/commands.h"
#include "client/spikectl/operator_servers.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/session/session_id.h"

namespace spikeserve {
namespace {

// Of a Box: the keys that lower and raise each of the first axes.
constexpr std::string_view kLower = "asjk";
constexpr std::string_view kRaise = "dwli";
constexpr float kStep = 0.1f;  // of an axis, as a share of its range
constexpr char kEscape = '\x1b';
constexpr char kEnd = '\x04';        // Ctrl-D
constexpr char kInterrupt = '\x03';  // Ctrl-C

struct TakeFlags {
  const ServerFlags* server = nullptr;
  std::string session;
  std::string operator_id;  // empty: $USER
  absl::Duration lease = absl::Seconds(1);
  absl::Duration attention = absl::Seconds(10);
  bool take_over = false;
};

// Reads single keys, if the standard input is a terminal, until it is destroyed.
class Keys {
 public:
  Keys() {
    if (tcgetattr(STDIN_FILENO, &before_) != 0) return;
    termios raw = before_;
    raw.c_lflag &= ~static_cast<tcflag_t>(ICANON | ECHO | ISIG);  // Ctrl-C is a key
    is_terminal_ = tcsetattr(STDIN_FILENO, TCSANOW, &raw) == 0;
  }
  ~Keys() {
    if (is_terminal_) tcsetattr(STDIN_FILENO, TCSANOW, &before_);
  }
  Keys(const Keys&) = delete;
  Keys& operator=(const Keys&) = delete;

  // Waits for a key. Returns 0 if none comes within `wait`, kEnd at the end of the input, and
  // kEscape for a key that sends several bytes, such as an arrow.
  static char Next(absl::Duration wait) {
    const char key = NextByte(wait);
    if (key == kEscape) SkipSequence();
    return key;
  }

 private:
  static char NextByte(absl::Duration wait) {
    pollfd input = {.fd = STDIN_FILENO, .events = POLLIN, .revents = 0};
    if (poll(&input, 1, static_cast<int>(absl::ToInt64Milliseconds(wait))) <= 0) return 0;
    char byte = 0;
    return read(STDIN_FILENO, &byte, 1) == 1 ? byte : kEnd;
  }

  // Reads what follows an escape at once: the key that was pressed with Alt, or `[` or `O`, then
  // digits and other signs, and the byte from `@` to `~` that ends the sequence.
  static void SkipSequence() {
    constexpr absl::Duration kGap = absl::Milliseconds(25);  // between two bytes of a key, at most
    char byte = kEscape;
    while (byte == kEscape) byte = NextByte(kGap);
    if (byte != '[' && byte != 'O') return;
    do {
      byte = NextByte(kGap);
    } while (byte >= ' ' && byte < '@');
  }

  termios before_ = {};
  bool is_terminal_ = false;
};

// Changes the action as `key` says, if it has a meaning.
void Press(char key, const v1::ActionSpace& space, const v1::Action& neutral, v1::Action* action) {
  if (key == ' ') {
    *action = neutral;
    return;
  }
  if (space.has_discrete()) {
    const int index = key - '0';
    if (index >= 0 && index <= 9 && index < space.discrete().n()) action->set_discrete(index);
    return;
  }
  const size_t lower = kLower.find(key);
  const size_t axis = std::min(lower, kRaise.find(key));
  if (axis >= static_cast<size_t>(space.box().low_size())) return;  // also if it is npos
  const int i = static_cast<int>(axis);
  const float low = space.box().low(i);
  const float high = space.box().high(i);
  const float step = (lower == axis ? -kStep : kStep) * (high - low);
  float& value = (*action->mutable_continuous()->mutable_values())[i];
  value = std::clamp(value + step, low, high);
}

std::string ToText(const v1::Action& action) {
  if (action.has_discrete()) return absl::StrCat(action.discrete());
  std::string text;
  for (const float value : action.continuous().values())
    absl::StrAppendFormat(&text, "%.3g ", value);
  return text;
}

std::string KeysOf(const v1::ActionSpace& space) {
  if (space.has_discrete())
    return absl::StrCat("keys 0 to ", std::min<int64_t>(space.discrete().n() - 1, 9));
  std::string text = "keys";
  for (int i = 0; i < std::min<int>(space.box().low_size(), static_cast<int>(kLower.size())); ++i) {
    absl::StrAppendFormat(&text, " %c %c", kLower[static_cast<size_t>(i)],
                          kRaise[static_cast<size_t>(i)]);
  }
  return text;
}

// Steers until the operator returns the session, or presses no key for `flags.attention`.
absl::Status Steer(const TakeFlags& flags, const v1::TakeControlResponse& taken,
                   OperatorServers& servers) {
  v1::SteerSessionRequest request;
  request.set_session_id(flags.session);
  request.set_lease_id(taken.lease_id());
  *request.mutable_action() = taken.action();
  const Keys keys;
  absl::Time pressed = absl::Now();
  while (absl::Now() - pressed < flags.attention) {
    const char key = Keys::Next(flags.lease / 4);
    if (key == 'q' || key == kEnd || key == kInterrupt) break;
    if (key != 0) pressed = absl::Now();
    Press(key, taken.action_space(), taken.action(), request.mutable_action());
    // A key without a meaning renews the lease, too: the operator is there.
    ASSIGN_OR_RETURN(const auto answer, servers.OfSession(&AdminStub::SteerSession, request));
    if (flags.server->json || key == 0) continue;
    std::cout << absl::StrFormat("step %d: %s; the policy agreed in %d of %d steps%s\n",
                                 answer.next_step(), ToText(request.action()),
                                 answer.agreed_steps(), answer.steps(),
                                 answer.has_hold() ? "; HELD: the operator is not heard" : "")
              << std::flush;
  }
  return absl::OkStatus();
}

absl::Status Take(const TakeFlags& flags) {
  if (flags.session.empty()) {
    return InvalidArgument("--session", "the id of a session", "none");
  }
  OperatorServers servers(*flags.server);
  v1::TakeControlRequest request;
  request.set_session_id(flags.session);
  const char* const user = std::getenv("USER");
  request.set_operator_id(flags.operator_id.empty() && user != nullptr ? user : flags.operator_id);
  ASSIGN_OR_RETURN(*request.mutable_lease_id(), NewSessionId());  // for calls that are repeated
  request.set_lease_seconds(absl::ToDoubleSeconds(flags.lease));
  request.set_take_over(flags.take_over);
  ASSIGN_OR_RETURN(const auto taken, servers.OfSession(&AdminStub::TakeControl, request));
  if (!flags.server->json) {
    std::cout << taken.operator_id() << " has control";
    if (!taken.relieved_operator_id().empty()) {
      std::cout << ", relieves " << taken.relieved_operator_id();
    }
    std::cout << "; " << KeysOf(taken.action_space())
              << ", space: the first action, q: return to the policy" << std::endl;
  }
  RETURN_IF_ERROR(Steer(flags, taken, servers));
  v1::ReturnControlRequest back;
  back.set_session_id(flags.session);
  back.set_lease_id(taken.lease_id());
  ASSIGN_OR_RETURN(const auto returned, servers.OfSession(&AdminStub::ReturnControl, back));
  if (flags.server->json) {
    std::cout << nlohmann::ordered_json{{"session_id", flags.session},
                                        {"operator_id", taken.operator_id()},
                                        {"steps", returned.steps()},
                                        {"agreed_steps", returned.agreed_steps()}}
                     .dump(2)
              << "\n";
  } else {
    std::cout << "returned after " << returned.steps() << " steps, in " << returned.agreed_steps()
              << " of which the policy agreed\n";
  }
  return absl::OkStatus();
}

}  // namespace

void AddTakeCommand(Command program, const ServerFlags& server) {
  const Command take = program.AddCommand("take", "Acts in a policy's place, by the keyboard");
  const auto flags = std::make_shared<TakeFlags>();
  flags->server = &server;
  take.Flags("Action")
      .Add("session", "ID", &flags->session, "Session to act in")
      .Add("operator", "NAME", &flags->operator_id, "Name of the operator; default: $USER")
      .Add("lease", "DURATION", &flags->lease, "Time after which the policy acts again by itself")
      .Add("attention", "DURATION", &flags->attention, "Longest time without a key")
      .AddSwitch("take_over", &flags->take_over, "Relieve another operator");
  take.SetAction([flags] { return Take(*flags); });
}

}  // namespace spikeserve
