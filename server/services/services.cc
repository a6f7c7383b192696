#include "server/services/services.h"

#include <utility>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "server/services/act_calls.h"
#include "server/services/infer_stream_call.h"
#include "server/services/reflection.h"

namespace spikeserve {
namespace {

constexpr char kReflection[] = "grpc.reflection.v1.ServerReflection";
constexpr char kReflectionAlpha[] = "grpc.reflection.v1alpha.ServerReflection";
constexpr char kHealth[] = "grpc.health.v1.Health";

// Finishes a call of a method that the server does not have.
class UnknownCall final : public CallHandler {
 public:
  explicit UnknownCall(Call* call) {
    call->Finish(absl::UnimplementedError(
        absl::StrCat("method: expected one that this server has, received ", call->head().path)));
  }
  size_t message_limit() const override { return 0; }
  void OnMessage(absl::string_view /*message*/) override {}
  void OnTooLong(size_t /*length*/) override {}
  void OnHalfClose() override {}
  void OnClosed() override {}
  void OnDrain() override {}
};

}  // namespace

void LoopServices::Attach(const std::vector<std::unique_ptr<LoopServices>>& all) {
  std::vector<ActQueue*> queues;
  for (const auto& services : all) queues.push_back(&services->acts_);
  acts_.SetQueues(std::move(queues));
  loop_.SetRouter(this);
  loop_.AtEndOfTurn([this] {
    acts_.Run();
    loop_.FlushWrites();
    deferred_.Run();
  });
}

std::shared_ptr<CallHandler> LoopServices::Route(Call* call) {
  const ServiceTable::Open* open = table_.Find(call->head().path);
  if (open == nullptr) return std::make_shared<UnknownCall>(call);
  return (*open)(call, this);
}

Services::Services(const ServiceContext& context, const Handlers& handlers)
    : context_(context), handlers_(handlers) {
  AddPolicyService();
  AddPolicyAdmin();
  AddInferenceService();
  AddStandardServices();
}

absl::Status Services::Attach(Transport* transport) {
  for (const auto& loop : transport->loops()) {
    loops_.push_back(std::make_unique<LoopServices>(&table_, handlers_.policy, loop.get()));
  }
  for (const auto& services : loops_) services->Attach(loops_);
  if (context_.datagrams == nullptr) return absl::OkStatus();
  for (size_t i = 0; i < loops_.size(); ++i) {
    datagrams_.push_back(std::make_unique<DatagramCalls>(&context_, &loops_[i]->acts(),
                                                         transport->loops()[i].get(),
                                                         transport->limits().max_tenant_bytes));
    RETURN_IF_ERROR(datagrams_.back()->Start());
  }
  return absl::OkStatus();
}

void Services::AddCall(const Method& method, OpenCall open) {
  if (service_names_.empty() || service_names_.back() != method.service) {
    service_names_.push_back(method.service);
  }
  table_.Add(method.path, [&method, open = std::move(open)](Call* call, LoopServices* loop) {
    auto opened = open(call, method, loop);
    opened->Start();
    return opened;
  });
}

void Services::Add(Handler handler) {
  const Method& method = MethodOf(*handler.request_type.GetDescriptor());
  if (!RunsOnLoop(method.cost)) {
    return AddBackground(method.cost == Cost::kListing ? handlers_.list_worker : handlers_.worker,
                         std::move(handler));
  }
  AddCall(method, [this, handler = std::move(handler)](Call* call, const Method& called,
                                                       LoopServices* loop) {
    return std::make_shared<InlineCall>(&context_, call, called, &loop->deferred(), &handler);
  });
}

void Services::AddBackground(BackgroundWorker* worker, Handler handler, bool is_recorded) {
  const Method& method = MethodOf(*handler.request_type.GetDescriptor());
  AddCall(method, [this, worker, handler = std::move(handler), is_recorded](
                      Call* call, const Method& called, LoopServices* /*loop*/) {
    return std::make_shared<BackgroundCall>(&context_, call, called, worker, &handler, is_recorded);
  });
}

void Services::AddAdmin(Handler handler) {
  const Method& method = MethodOf(*handler.request_type.GetDescriptor());
  if (method.access == Access::kOperatorOnly) return AddRecorded(std::move(handler));
  AddBackground(handlers_.list_worker, std::move(handler));
}

void Services::AddRecorded(Handler handler) {
  using google::protobuf::Message;
  const Method& method = MethodOf(*handler.request_type.GetDescriptor());
  // What agents and viewers ask for does not stand in the way of operators.
  const bool is_operators = method.access == Access::kOperatorOnly;
  handler.answer = [audit = handlers_.audit, &method, answer = std::move(handler.answer)](
                       CallContext& context, const Message& request, Message* response) {
    const auto change = [&] { return answer(context, request, response); };
    const auto* push = google::protobuf::DynamicCastToGenerated<v1::PushPolicyRequest>(&request);
    if (push == nullptr) return audit->RunAndRecord(method, context, request, change);
    return audit->RunAndRecord(method, context, WithoutData(*push), change);
  };
  AddBackground(is_operators ? handlers_.admin_worker : handlers_.worker, std::move(handler),
                /*is_recorded=*/true);
}

void Services::AddPolicyService() {
  const PolicyHandler* policy = handlers_.policy;
  Add({policy, &PolicyHandler::ListPolicies});
  Add({policy, &PolicyHandler::OpenSession});
  Add({policy, &PolicyHandler::EndEpisode});
  Add({policy, &PolicyHandler::AmendEpisode});
  Add({policy, &PolicyHandler::GetSession});
  Add({policy, &PolicyHandler::CloseSession});
  Add({policy, &PolicyHandler::Explain});
  AddRecorded({policy, &PolicyHandler::ExportSession});
  AddCall(MethodNamed("ActBatch"), [this](Call* call, const Method& method, LoopServices* loop) {
    return std::make_shared<ActBatchCall>(&context_, call, method, &loop->acts());
  });
  for (const char* name : {"Act", "ActStream"}) {
    AddCall(MethodNamed(name), [this](Call* call, const Method& method, LoopServices* loop) {
      return std::make_shared<ActCall>(&context_, call, method, &loop->acts());
    });
  }
}

void Services::AddPolicyAdmin() {
  const AdminHandler* admin = handlers_.admin;
  AddAdmin({admin, &AdminHandler::LoadPolicy});
  AddAdmin({admin, &AdminHandler::UnloadPolicy});
  AddAdmin({admin, &AdminHandler::ReloadPolicies});
  AddAdmin({admin, &AdminHandler::SetDefaultVersion});
  AddAdmin({admin, &AdminHandler::SetLabel});
  AddAdmin({admin, &AdminHandler::RemoveLabel});
  AddAdmin({admin, &AdminHandler::SetTraffic});
  AddAdmin({admin, &AdminHandler::SetTrafficShares});
  AddAdmin({admin, &AdminHandler::SetShadow});
  AddAdmin({admin, &AdminHandler::ListHistory});
  AddAdmin({admin, &AdminHandler::ListSessions});
  AddAdmin({admin, &AdminHandler::Drain});
  AddAdmin({admin, &AdminHandler::GetUsage});
  AddAdmin({admin, &AdminHandler::PushPolicy});
  AddAdmin({admin, &AdminHandler::PullPolicy});
  AddAdmin({admin, &AdminHandler::RemovePolicy});
  AddAdmin({admin, &AdminHandler::StartRollout});
  AddAdmin({admin, &AdminHandler::AbortRollout});
  AddAdmin({admin, &AdminHandler::ListRollouts});
  AddAdmin({admin, &AdminHandler::GetHead});
  AddAdmin({admin, &AdminHandler::PromoteHead});
  AddAdmin({admin, &AdminHandler::RollbackHead});
  AddAdmin({admin, &AdminHandler::UndoCorrections});
  AddAdmin({admin, &AdminHandler::PauseLearning});
  AddAdmin({admin, &AdminHandler::ResumeLearning});
  AddAdmin({admin, &AdminHandler::HoldSessions});
  AddAdmin({admin, &AdminHandler::ResumeSessions});
  AddAdmin({admin, &AdminHandler::ListHolds});
  AddAdmin({admin, &AdminHandler::TakeControl});
  Add({admin, &AdminHandler::SteerSession});  // as often as an agent acts, so it is not recorded
  AddAdmin({admin, &AdminHandler::ReturnControl});
}

void Services::AddInferenceService() {
  const InferenceHandler* handler = handlers_.inference;
  Add({handler, &InferenceHandler::ServerLive});
  Add({handler, &InferenceHandler::ServerReady});
  Add({handler, &InferenceHandler::ModelReady});
  Add({handler, &InferenceHandler::ServerMetadata});
  Add({handler, &InferenceHandler::ModelMetadata});
  // Its requests have the type of ModelStreamInfer's, too; MethodOf() means the unary method.
  Add({handler, &InferenceHandler::ModelInfer});
  Add({handler, &InferenceHandler::ModelConfig});
  Add({handler, &InferenceHandler::ModelStatistics});
  Add({handler, &InferenceHandler::RepositoryIndex});
  AddAdmin({handler, &InferenceHandler::RepositoryModelLoad});
  AddAdmin({handler, &InferenceHandler::RepositoryModelUnload});
  AddCall(MethodNamed("ModelStreamInfer"),
          [this](Call* call, const Method& method, LoopServices* loop) {
            return std::make_shared<InferStreamCall>(&context_, call, method, handlers_.inference,
                                                     &loop->deferred());
          });
}

void Services::AddStandardServices() {
  table_.Add(absl::StrCat("/", kHealth, "/Check"),
             [this](Call* call, LoopServices* /*loop*/) { return handlers_.health->Check(call); });
  table_.Add(absl::StrCat("/", kHealth, "/Watch"),
             [this](Call* call, LoopServices* /*loop*/) { return handlers_.health->Watch(call); });
  service_names_.emplace_back(kHealth);
  const auto add_reflection = [this](const char* name) {
    service_names_.emplace_back(name);
    table_.Add(absl::StrCat("/", name, "/ServerReflectionInfo"),
               [this](Call* call, LoopServices* /*loop*/) {
                 return std::make_shared<ReflectionCall>(call, &service_names_);
               });
  };
  add_reflection(kReflection);
  if (handlers_.reflection_v1alpha) add_reflection(kReflectionAlpha);
}

}  // namespace spikeserve
