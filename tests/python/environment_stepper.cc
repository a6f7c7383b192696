// Steps an environment by JSON lines, for tests in other languages.
//
// Usage: environment_stepper ID. Each line of standard input is one of
//   {"seed": 7}                  Reset
//   {"state": [0.1, -0.2]}       ResetTo
//   {"action": 1} or {"action": [0.5]}   Step
// and is answered by one line with `observation` and `state`, and after a step also `reward`,
// `terminated` and `truncated`. Numbers are written with enough digits to be read back bit for bit.
// An invalid line ends the program with status 1.
#include <cstdint>
#include <exception>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "core/environment/environment.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

Action ParseAction(const Json& json, const ActionSpace& space) {
  Action action;
  if (space.is_discrete()) {
    json.get_to(action.discrete);
  } else {
    json.get_to(action.continuous);
  }
  const absl::Status status = space.Contains(action);
  if (!status.ok()) throw std::invalid_argument(status.ToString());
  return action;
}

Json Answer(const Json& request, Environment& environment) {
  Json answer;
  if (request.contains("seed")) {
    answer["observation"] = environment.Reset(request["seed"].get<uint64_t>());
  } else if (request.contains("state")) {
    const auto state = request["state"].get<std::vector<double>>();
    if (state.size() != environment.state().size()) {
      throw std::invalid_argument("state: expected " + std::to_string(environment.state().size()) +
                                  " numbers, received " + std::to_string(state.size()));
    }
    answer["observation"] = environment.ResetTo(state);
  } else {
    const StepResult result =
        environment.Step(ParseAction(request.at("action"), environment.action_space()));
    answer = {{"observation", result.observation},
              {"reward", result.reward},
              {"terminated", result.terminated},
              {"truncated", result.truncated}};
  }
  answer["state"] = std::vector<double>(environment.state().begin(), environment.state().end());
  return answer;
}

int Run(const std::string& id) {
  auto environment = MakeEnvironment(id);
  if (!environment.ok()) throw std::invalid_argument(environment.status().ToString());
  for (std::string line; std::getline(std::cin, line);) {
    std::cout << Answer(Json::parse(line), **environment) << std::endl;
  }
  return 0;
}

}  // namespace
}  // namespace spikeserve

int main(int argc, char** argv) {
  if (argc != 2) {
    std::cerr << "usage: environment_stepper ID\n";
    return 2;
  }
  try {
    return spikeserve::Run(argv[1]);
  } catch (const std::exception& error) {
    std::cerr << "environment_stepper: " << error.what() << '\n';
    return 1;
  }
}
