// Explanations of a hostile server: `spikectl explain` prints each, or names what is wrong.
//
// An input is an ExplainResponse in the encoding of protobuf.
#include "client/spikectl/explain_report.h"
#include "core/base/printable.h"
#include "tests/fuzz/fuzz_target.h"

namespace spikeserve {
namespace {

v1::ExplainResponse Valid() {
  v1::ExplainResponse explained;
  explained.set_ticks(2);
  explained.set_heads(2);
  v1::SpikeRaster& raster = *explained.add_rasters();
  raster.set_population(3);
  raster.add_ticks(1);
  raster.add_neurons(2);
  v1::RoutingGates& routing = *explained.add_routing();
  routing.add_tokens()->set_timestep(4);
  v1::Attention& attention = *explained.add_attention();
  attention.set_ticks(2);
  attention.add_keys()->set_timestep(1);
  for (int i = 0; i < 4; ++i) {
    routing.add_gates(0.5f);
    attention.add_weights(1.0f);
  }
  return explained;
}

}  // namespace

void FuzzOne(absl::string_view input) {
  v1::ExplainResponse explained;
  if (!explained.ParseFromArray(input.data(), static_cast<int>(input.size()))) return;
  const auto text = ExplainToText(explained, {});
  if (!text.ok()) FUZZ_CHECK(!text.status().message().empty());
  for (absl::string_view rest = input; !rest.empty();) {
    const size_t bytes = FirstCharacter(rest).bytes;
    FUZZ_CHECK(bytes <= rest.size());
    if (bytes == 0) break;
    rest.remove_prefix(bytes);
  }
}

std::vector<std::string> Seeds() {
  const v1::ExplainResponse valid = Valid();
  v1::ExplainResponse tick = valid, neuron = valid, gates = valid, kind = valid, heads = valid;
  tick.mutable_rasters(0)->set_ticks(0, 1 << 30);
  neuron.mutable_rasters(0)->set_neurons(0, -1);
  gates.mutable_routing(0)->clear_gates();
  kind.mutable_attention(0)->mutable_keys(0)->set_kind(static_cast<v1::Token::Kind>(9));
  heads.set_heads(1 << 30);
  std::vector<std::string> seeds;
  for (const v1::ExplainResponse& seed : {valid, tick, neuron, gates, kind, heads}) {
    seeds.push_back(seed.SerializeAsString());
  }
  return seeds;
}

}  // namespace spikeserve
