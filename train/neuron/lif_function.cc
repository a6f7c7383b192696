#include "train/neuron/lif_function.h"

#include <ATen/Parallel.h>
#include <torch/csrc/autograd/custom_function.h>

#include "train/neuron/lif_kernels.h"
#include "train/neuron/lif_operators.h"

namespace spikeserve {
namespace {

using torch::autograd::AutogradContext;
using torch::autograd::tensor_list;

constexpr int64_t kNeuronsPerTask = 16384;

// Returns the rows of a tensor [T, ...] if `per_tick`, otherwise a tensor [...] that is the same
// row at every tick.
TickRows Rows(const torch::Tensor& tensor, bool per_tick, int64_t neurons) {
  return {tensor.data_ptr<float>(), per_tick ? neurons : 0};
}

// Returns whether `gradient` is broadcast over the ticks, as the gradient of a sum over ticks is.
// Making it contiguous would cost more than the backward pass itself.
bool SameAtEveryTick(const torch::Tensor& gradient) {
  return gradient.stride(0) == 0 && gradient.select(0, 0).is_contiguous();
}

void SaveSurrogate(const Surrogate& surrogate, AutogradContext* context) {
  context->saved_data["kind"] = static_cast<int64_t>(surrogate.kind);
  context->saved_data["slope"] = static_cast<double>(surrogate.slope);
}

Surrogate SavedSurrogate(AutogradContext* context) {
  auto& saved = context->saved_data;
  return {.kind = static_cast<SurrogateKind>(saved["kind"].toInt()),
          .slope = static_cast<float>(saved["slope"].toDouble())};
}

struct LifFunction : torch::autograd::Function<LifFunction> {
  static torch::Tensor forward(AutogradContext* context, const torch::Tensor& input, bool per_tick,
                               const LifOptions& options) {
    const torch::Tensor current = input.contiguous();
    context->save_for_backward({current});
    context->saved_data["per_tick"] = per_tick;
    context->saved_data["ticks"] = static_cast<int64_t>(options.ticks);
    context->saved_data["decay"] = static_cast<double>(options.neuron.decay);
    context->saved_data["threshold"] = static_cast<double>(options.neuron.threshold);
    SaveSurrogate(options.surrogate, context);
    if (!current.is_cpu()) {
      return LifForwardOperators(options.neuron, options.ticks, !per_tick, current);
    }
    const int64_t neurons = per_tick ? current.numel() / options.ticks : current.numel();
    std::vector<int64_t> shape = current.sizes().vec();
    if (!per_tick) shape.insert(shape.begin(), options.ticks);
    torch::Tensor spikes = torch::empty(shape, current.options());
    float* out = spikes.data_ptr<float>();
    at::parallel_for(0, neurons, kNeuronsPerTask, [&](int64_t begin, int64_t end) {
      LifForward({options.neuron, options.ticks, begin, end}, Rows(current, per_tick, neurons), out,
                 neurons);
    });
    return spikes;
  }

  static tensor_list backward(AutogradContext* context, tensor_list gradients) {
    auto& saved = context->saved_data;
    const torch::Tensor current = context->get_saved_variables()[0];
    const bool per_tick = saved["per_tick"].toBool();
    const int ticks = static_cast<int>(saved["ticks"].toInt());
    const Lif neuron = {.decay = static_cast<float>(saved["decay"].toDouble()),
                        .threshold = static_cast<float>(saved["threshold"].toDouble())};
    const Surrogate surrogate = SavedSurrogate(context);
    if (!current.is_cpu()) {
      return {LifBackwardOperators(neuron, ticks, !per_tick, surrogate, current, gradients[0]),
              torch::Tensor(), torch::Tensor()};
    }
    const int64_t neurons = per_tick ? current.numel() / ticks : current.numel();
    const bool same = SameAtEveryTick(gradients[0]);
    const torch::Tensor spike_gradient = same ? gradients[0] : gradients[0].contiguous();
    torch::Tensor result = torch::empty_like(current);
    float* out = result.data_ptr<float>();
    at::parallel_for(0, neurons, kNeuronsPerTask, [&](int64_t begin, int64_t end) {
      LifBackward({neuron, ticks, begin, end}, surrogate, Rows(current, per_tick, neurons),
                  Rows(spike_gradient, !same, neurons), out);
    });
    return {result, torch::Tensor(), torch::Tensor()};
  }
};

struct IntegerLifFunction : torch::autograd::Function<IntegerLifFunction> {
  // Returns all neurons of a current. The tensors of `options` must outlive the result.
  static IntegerLifRange Range(const IntegerLifOptions& options) {
    return {.neuron = options.neuron,
            .ticks = options.ticks,
            .begin = 0,
            .end = 0,
            .threshold = options.threshold.data_ptr<float>(),
            .scale = options.scale.data_ptr<float>(),
            .width = options.threshold.numel(),
            .bias = options.bias.data_ptr<float>(),
            .events = {options.events.data_ptr<float>(), options.events.numel() / options.ticks}};
  }

  static torch::Tensor forward(AutogradContext* context, const torch::Tensor& input,
                               const IntegerLifOptions& options) {
    const torch::Tensor current = input.contiguous();
    const int64_t neurons = current.numel() / options.ticks;
    torch::Tensor spikes = torch::empty_like(current);
    float* out = spikes.data_ptr<float>();
    const IntegerLifRange all = Range(options);
    at::parallel_for(0, neurons, kNeuronsPerTask, [&](int64_t begin, int64_t end) {
      IntegerLifRange range = all;
      range.begin = begin;
      range.end = end;
      IntegerLifForward(range, Rows(current, true, neurons), out, neurons);
    });
    context->save_for_backward(
        {current, options.threshold, options.scale, options.bias, options.events});
    context->saved_data["ticks"] = static_cast<int64_t>(options.ticks);
    context->saved_data["leak"] = static_cast<int64_t>(options.neuron.leak);
    SaveSurrogate(options.surrogate, context);
    return spikes;
  }

  static tensor_list backward(AutogradContext* context, tensor_list gradients) {
    auto& saved = context->saved_data;
    const auto tensors = context->get_saved_variables();
    const torch::Tensor& current = tensors[0];
    const IntegerLifOptions options = {.neuron = ShiftLif{static_cast<int>(saved["leak"].toInt())},
                                       .threshold = tensors[1],
                                       .scale = tensors[2],
                                       .ticks = static_cast<int>(saved["ticks"].toInt()),
                                       .surrogate = SavedSurrogate(context),
                                       .bias = tensors[3],
                                       .events = tensors[4]};
    const IntegerLifRange all = Range(options);
    const int64_t neurons = current.numel() / options.ticks;
    const bool same = SameAtEveryTick(gradients[0]);
    const torch::Tensor spike_gradient = same ? gradients[0] : gradients[0].contiguous();
    torch::Tensor result = torch::empty_like(current);
    float* out = result.data_ptr<float>();
    at::parallel_for(0, neurons, kNeuronsPerTask, [&](int64_t begin, int64_t end) {
      IntegerLifRange range = all;
      range.begin = begin;
      range.end = end;
      IntegerLifBackward(range, options.surrogate, Rows(current, true, neurons),
                         Rows(spike_gradient, !same, neurons), out);
    });
    return {result, torch::Tensor()};
  }
};

}  // namespace

torch::Tensor LifConstant(const torch::Tensor& current, const LifOptions& options) {
  return LifFunction::apply(current, false, options);
}

torch::Tensor LifPerTick(const torch::Tensor& current, const LifOptions& options) {
  return LifFunction::apply(current, true, options);
}

torch::Tensor IntegerLifPerTick(const torch::Tensor& current, const IntegerLifOptions& options) {
  return IntegerLifFunction::apply(current, options);
}

}  // namespace spikeserve
