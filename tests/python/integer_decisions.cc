// Converts a policy to integer arithmetic and decides by JSON lines, for tests in other languages.
//
// Usage: integer_decisions FLOAT_POLICY INTEGER_POLICY MODE, or INTEGER_POLICY alone.
// Writes INTEGER_POLICY, then decides one episode with the engine of the server. Each line of
// standard input has `return_to_go`, `observation` and, except the first one, `last_action`
// (encoded), and is answered by one line with `spikes` by stage, `readout`, and `joules` by energy
// model. An error ends the program with status 1.
#include <exception>
#include <iostream>
#include <memory>
#include <nlohmann/json.hpp>
#include <stdexcept>
#include <string>
#include <vector>

#include "core/engine/energy.h"
#include "core/engine/factory/engine_factory.h"
#include "core/model/policy_file.h"
#include "core/quantize/quantize_integer.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

template <class T>
T ValueOf(absl::StatusOr<T> value) {
  if (!value.ok()) throw std::invalid_argument(value.status().ToString());
  return *std::move(value);
}

Json Answer(const Engine::Output& output, const ModelConfig& config) {
  Json spikes = Json::object();
  for (const auto& [stage, name] : EnumNames(Stage())) {
    spikes[std::string(name)] = output.counts.spikes(stage);
  }
  Json joules = Json::object();
  for (const auto& [model, name] : EnumNames(EnergyModel())) {
    const auto estimate = EstimateEnergy(model, output.counts, config);
    if (estimate.has_value()) joules[std::string(name)] = *estimate;
  }
  return {{"spikes", spikes}, {"readout", output.readout}, {"joules", joules}};
}

// Converts the policy of the arguments.
void Convert(char** arguments) {
  const Policy policy = ValueOf(ReadPolicyFile(arguments[1]));
  const IntegerOptions options = {.mode = ValueOf(ParseEnum<Mode>("MODE", arguments[3]))};
  const Policy integer = ValueOf(QuantizeToInteger(policy, options));
  const absl::Status written = WritePolicyFile(integer, arguments[2]);
  if (!written.ok()) throw std::invalid_argument(written.ToString());
}

void Decide(const char* path) {
  const auto engine = MakeEngine(ValueOf(ReadPolicyFile(path)));
  const auto context = engine->NewContext();
  Engine::Output output;
  for (std::string line; std::getline(std::cin, line);) {
    const Json json = Json::parse(line);
    if (json.contains("last_action")) {
      engine->AppendAction(*context, json["last_action"].get<std::vector<float>>());
    }
    engine->Decide(*context, json["return_to_go"].get<float>(),
                   json["observation"].get<std::vector<float>>(), &output);
    std::cout << Answer(output, engine->policy().config).dump() << std::endl;
  }
}

}  // namespace
}  // namespace spikeserve

int main(int argc, char** argv) {
  try {
    if (argc != 2 && argc != 4) {
      throw std::invalid_argument("expected FLOAT_POLICY INTEGER_POLICY MODE, or a policy");
    }
    if (argc == 4) spikeserve::Convert(argv);
    spikeserve::Decide(argv[argc == 4 ? 2 : 1]);
  } catch (const std::exception& error) {
    std::cerr << error.what() << "\n";
    return 1;
  }
}
