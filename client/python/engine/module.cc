#include "client/python/engine/bindings.h"

NB_MODULE(_engine, module) {
  module.doc() = "The streaming engine and sessions of spikeserve.";
  spikeserve::BindValues(module);
  spikeserve::BindExplanation(module);
  spikeserve::BindEngine(module);
}
