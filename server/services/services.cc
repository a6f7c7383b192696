#include "server/services/services.h"

#include <utility>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "server/services/act_calls.h"
#include "server/services/infer_stream_call.h"
#include "server/services/reflection.h"
#include "server/services/service_name.h"

namespace spikeserve {
namespace {

constexpr char kReflection[] = "grpc.reflection.v1.ServerReflection";
constexpr char kReflectionAlpha[] = "grpc.reflection.v1alpha.ServerReflection";
constexpr char kHealth[] = "grpc.health.v1.Health";

}  // namespace

Services::Services(const ServiceContext& context, const Handlers& handlers)
    : context_(context), handlers_(handlers) {
  AddPolicyService();
  AddPolicyAdmin();
  AddInferenceService();
  AddStandardServices();
}

void Services::Attach(Transport* transport) {
  for (const auto& loop : transport->loops()) {
    loops_.push_back(std::make_unique<LoopServices>(&table_, handlers_.policy, loop.get()));
  }
  for (const auto& services : loops_) services->Attach(loops_);
}

void Services::AddCall(Method method,
                       std::function<std::shared_ptr<ServiceCall>(Call*, LoopServices*)> open) {
  table_.Add(absl::StrCat(service_, GetMethodInfo(method).name),
             [open = std::move(open)](Call* call, LoopServices* loop) {
               auto opened = open(call, loop);
               opened->Start();
               return opened;
             });
}

template <typename H, typename Request, typename Response>
void Services::Add(Method method, const H* handler, HandlerMethod<H, Request, Response> answer) {
  Handler<Request, Response> bound = std::bind_front(answer, handler);
  const Cost cost = GetMethodInfo(method).cost;
  if (!RunsOnLoop(cost)) {
    return AddBackground(method, cost == Cost::kListing ? handlers_.list_worker : handlers_.worker,
                         std::move(bound));
  }
  AddCall(method, [this, method, bound = std::move(bound)](Call* call, LoopServices* loop) {
    return std::make_shared<InlineCall<Request, Response>>(&context_, call, method,
                                                           &loop->deferred(), &bound);
  });
}

template <typename Request, typename Response>
void Services::AddBackground(Method method, BackgroundWorker* worker,
                             Handler<Request, Response> handler, bool is_recorded) {
  AddCall(method, [this, method, worker, handler = std::move(handler), is_recorded](
                      Call* call, LoopServices* /*loop*/) {
    return std::make_shared<BackgroundCall<Request, Response>>(&context_, call, method, worker,
                                                               &handler, is_recorded);
  });
}

template <typename H, typename Request, typename Response>
void Services::AddAdmin(Method method, const H* handler,
                        HandlerMethod<H, Request, Response> answer) {
  if (GetMethodInfo(method).access == Access::kOperatorOnly) {
    return AddRecorded(method, handler, answer);
  }
  AddBackground<Request, Response>(method, handlers_.admin_worker,
                                   std::bind_front(answer, handler));
}

template <typename H, typename Request, typename Response>
void Services::AddRecorded(Method method, const H* handler,
                           HandlerMethod<H, Request, Response> answer) {
  AddBackground<Request, Response>(
      method, handlers_.admin_worker,
      [audit = handlers_.audit, method, handler, answer](
          CallContext& context, const Request& request, Response* response) {
        return audit->RunAndRecord(method, context, request,
                                   [&] { return (handler->*answer)(context, request, response); });
      },
      /*is_recorded=*/true);
}

void Services::AddPolicyService() {
  service_names_.push_back(ServiceName<v1::ListPoliciesRequest>());
  service_ = absl::StrCat("/", service_names_.back(), "/");
  const PolicyHandler* policy = handlers_.policy;
  Add(Method::kListPolicies, policy, &PolicyHandler::ListPolicies);
  Add(Method::kOpenSession, policy, &PolicyHandler::OpenSession);
  Add(Method::kEndEpisode, policy, &PolicyHandler::EndEpisode);
  Add(Method::kGetSession, policy, &PolicyHandler::GetSession);
  Add(Method::kCloseSession, policy, &PolicyHandler::CloseSession);
  Add(Method::kExplain, policy, &PolicyHandler::Explain);
  AddRecorded(Method::kExportSession, policy, &PolicyHandler::ExportSession);
  AddCall(Method::kAct, [this](Call* call, LoopServices* loop) {
    return std::make_shared<ActOneCall>(&context_, call, &loop->acts());
  });
  AddCall(Method::kActBatch, [this](Call* call, LoopServices* loop) {
    return std::make_shared<ActBatchCall>(&context_, call, &loop->acts());
  });
  AddCall(Method::kActStream, [this](Call* call, LoopServices* loop) {
    return std::make_shared<ActStreamCall>(&context_, call, &loop->acts());
  });
}

void Services::AddPolicyAdmin() {
  service_names_.push_back(ServiceName<v1::LoadPolicyRequest>());
  service_ = absl::StrCat("/", service_names_.back(), "/");
  const auto add_admin = [this](Method method, auto handler_method) {
    AddAdmin(method, handlers_.admin, handler_method);
  };
  add_admin(Method::kLoadPolicy, &AdminHandler::LoadPolicy);
  add_admin(Method::kUnloadPolicy, &AdminHandler::UnloadPolicy);
  add_admin(Method::kReloadPolicies, &AdminHandler::ReloadPolicies);
  add_admin(Method::kSetDefaultVersion, &AdminHandler::SetDefaultVersion);
  add_admin(Method::kSetLabel, &AdminHandler::SetLabel);
  add_admin(Method::kRemoveLabel, &AdminHandler::RemoveLabel);
  add_admin(Method::kSetTraffic, &AdminHandler::SetTraffic);
  add_admin(Method::kSetTrafficShares, &AdminHandler::SetTrafficShares);
  add_admin(Method::kSetShadow, &AdminHandler::SetShadow);
  add_admin(Method::kListHistory, &AdminHandler::ListHistory);
  const auto add_rollouts = [this](Method method, auto handler_method) {
    AddAdmin(method, handlers_.rollouts, handler_method);
  };
  add_rollouts(Method::kStartRollout, &RolloutHandler::StartRollout);
  add_rollouts(Method::kAbortRollout, &RolloutHandler::AbortRollout);
  add_rollouts(Method::kListRollouts, &RolloutHandler::ListRollouts);
  add_admin(Method::kListSessions, &AdminHandler::ListSessions);
  add_admin(Method::kDrain, &AdminHandler::Drain);
  const auto add_heads = [this](Method method, auto handler_method) {
    AddAdmin(method, handlers_.heads, handler_method);
  };
  add_heads(Method::kGetHead, &HeadHandler::GetHead);
  add_heads(Method::kPromoteHead, &HeadHandler::PromoteHead);
  add_heads(Method::kRollbackHead, &HeadHandler::RollbackHead);
  add_heads(Method::kPauseLearning, &HeadHandler::PauseLearning);
  add_heads(Method::kResumeLearning, &HeadHandler::ResumeLearning);
}

void Services::AddInferenceService() {
  service_names_.push_back(ServiceName<inference::ServerLiveRequest>());
  service_ = absl::StrCat("/", service_names_.back(), "/");
  const InferenceHandler* handler = handlers_.inference;
  Add(Method::kServerLive, handler, &InferenceHandler::ServerLive);
  Add(Method::kServerReady, handler, &InferenceHandler::ServerReady);
  Add(Method::kModelReady, handler, &InferenceHandler::ModelReady);
  Add(Method::kServerMetadata, handler, &InferenceHandler::ServerMetadata);
  Add(Method::kModelMetadata, handler, &InferenceHandler::ModelMetadata);
  Add(Method::kModelInfer, handler, &InferenceHandler::ModelInfer);
  Add(Method::kModelConfig, handler, &InferenceHandler::ModelConfig);
  Add(Method::kModelStatistics, handler, &InferenceHandler::ModelStatistics);
  Add(Method::kRepositoryIndex, handler, &InferenceHandler::RepositoryIndex);
  AddAdmin(Method::kRepositoryModelLoad, handler, &InferenceHandler::RepositoryModelLoad);
  AddAdmin(Method::kRepositoryModelUnload, handler, &InferenceHandler::RepositoryModelUnload);
  AddCall(Method::kModelStreamInfer, [this](Call* call, LoopServices* loop) {
    return std::make_shared<InferStreamCall>(&context_, call, handlers_.inference,
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
