#include "server/services/services.h"

#include <utility>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "server/services/act_calls.h"
#include "server/services/handler_calls.h"
#include "server/services/infer_stream_call.h"
#include "server/services/reflection.h"
#include "server/services/service_name.h"

namespace spikeserve {
namespace {

constexpr char kReflection[] = "grpc.reflection.v1.ServerReflection";
constexpr char kReflectionAlpha[] = "grpc.reflection.v1alpha.ServerReflection";
constexpr char kHealth[] = "grpc.health.v1.Health";

template <typename RequestType, typename ResponseType>
struct Messages {
  using Request = RequestType;
  using Response = ResponseType;
};

// Name the messages of a handler's method in each of its forms. Declared only.
template <typename H, typename Request, typename Response>
Messages<Request, Response> MessagesOf(absl::Status (H::*)(const Request&, Response*) const);
template <typename H, typename Request, typename Response>
Messages<Request, Response> MessagesOf(absl::Status (H::*)(const Credential&, const Request&,
                                                           Response*) const);
template <typename H, typename Request, typename Response>
Messages<Request, Response> MessagesOf(absl::Status (H::*)(const Credential&, const Request&,
                                                           Response*, DeferredWork*) const);
template <typename H, typename Request, typename Response>
Messages<Request, Response> MessagesOf(absl::Status (H::*)(const Credential&, const Request&,
                                                           Response*, DeferredWork*));
template <typename H, typename Request, typename Response>
Messages<Request, Response> MessagesOf(absl::Status (H::*)(const Credential&, const Request&,
                                                           Response*, Commits*) const);
template <typename H, typename Request, typename Response>
Messages<Request, Response> MessagesOf(absl::Status (H::*)(const Credential&, const Request&,
                                                           Response*, Commits*, bool) const);
template <typename H, typename Request, typename Response>
Messages<Request, Response> MessagesOf(absl::Status (H::*)(const Credential&, const Request&,
                                                           Response*, DeferredWork*, Commits*)
                                           const);

std::shared_ptr<CallHandler> Started(std::shared_ptr<ServiceCall> call) {
  call->Start();
  return call;
}

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
    loops_.push_back(
        std::make_unique<LoopServices>(&table_, handlers_.policy, context_.recovery, loop.get()));
  }
  for (const auto& services : loops_) services->Attach(loops_);
}

template <typename Handler, typename HandlerMethod>
void Services::Add(Method method, Handler* handler, HandlerMethod handler_method) {
  const Cost cost = GetMethodInfo(method).cost;
  if (RunsOnLoop(cost)) return AddInline(method, handler, handler_method);
  AddBackground(method, handler, handler_method,
                cost == Cost::kListing ? handlers_.list_worker : handlers_.worker);
}

template <typename Handler, typename HandlerMethod>
void Services::AddInline(Method method, Handler* handler, HandlerMethod handler_method) {
  using Types = decltype(MessagesOf(handler_method));
  using Request = typename Types::Request;
  using Response = typename Types::Response;
  const auto answer = [handler, handler_method](const Credential& caller, const Request& request,
                                                Response* response, DeferredWork* deferred,
                                                Commits* commits, bool may_claim) {
    return CallOutcome(
        Invoke(*handler, handler_method, caller, request, response, deferred, commits, may_claim));
  };
  using AnswerType = decltype(answer);
  table_.Add(absl::StrCat(service_, GetMethodInfo(method).name),
             [this, method, answer](Call* call, LoopServices* loop) {
               return Started(std::make_shared<InlineCall<Request, Response, AnswerType>>(
                   &context_, call, method, &loop->deferred(), &answer));
             });
}

template <typename Handler, typename HandlerMethod>
void Services::AddBackground(Method method, Handler* handler, HandlerMethod handler_method,
                             BackgroundWorker* worker) {
  using Types = decltype(MessagesOf(handler_method));
  using Request = typename Types::Request;
  using Response = typename Types::Response;
  const auto answer = [handler, handler_method](const Credential& caller, const Request& request,
                                                Response* response, DeferredWork* deferred,
                                                Commits* commits, bool may_claim) {
    return CallOutcome(
        Invoke(*handler, handler_method, caller, request, response, deferred, commits, may_claim));
  };
  using AnswerType = decltype(answer);
  table_.Add(absl::StrCat(service_, GetMethodInfo(method).name),
             [this, method, worker, answer](Call* call, LoopServices* /*loop*/) {
               return Started(std::make_shared<BackgroundCall<Request, Response, AnswerType>>(
                   &context_, call, method, worker, &answer));
             });
}

template <typename Handler, typename HandlerMethod>
void Services::AddAdmin(Method method, Handler* handler, HandlerMethod handler_method) {
  if (GetMethodInfo(method).access != Access::kOperatorOnly) {
    return AddBackground(method, handler, handler_method, handlers_.admin_worker);
  }
  AddRecorded(method, handler, handler_method);
}

template <typename Handler, typename HandlerMethod>
void Services::AddRecorded(Method method, Handler* handler, HandlerMethod handler_method) {
  using Types = decltype(MessagesOf(handler_method));
  using Request = typename Types::Request;
  using Response = typename Types::Response;
  const auto answer = [audit = handlers_.audit, method, handler, handler_method](
                          const Credential& caller, const Peer& peer, const Request& request,
                          Response* response) {
    return CallOutcome(audit->RunAndRecord(method, caller, peer, request, [&] {
      return Invoke(*handler, handler_method, caller, request, response, nullptr, nullptr,
                    /*may_claim=*/false);
    }));
  };
  using AnswerType = decltype(answer);
  table_.Add(absl::StrCat(service_, GetMethodInfo(method).name),
             [this, method, answer](Call* call, LoopServices* /*loop*/) {
               return Started(std::make_shared<BackgroundCall<Request, Response, AnswerType>>(
                   &context_, call, method, handlers_.admin_worker, &answer));
             });
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
  table_.Add(absl::StrCat(service_, GetMethodInfo(Method::kAct).name),
             [this](Call* call, LoopServices* loop) {
               return Started(std::make_shared<ActCall>(&context_, call, &loop->acts()));
             });
  table_.Add(absl::StrCat(service_, GetMethodInfo(Method::kActBatch).name),
             [this](Call* call, LoopServices* loop) {
               return Started(std::make_shared<ActBatchCall>(&context_, call, &loop->acts()));
             });
  table_.Add(absl::StrCat(service_, GetMethodInfo(Method::kActStream).name),
             [this](Call* call, LoopServices* loop) {
               return Started(std::make_shared<ActStreamCall>(&context_, call, &loop->acts()));
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
  InferenceHandler* handler = handlers_.inference;
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
  table_.Add(absl::StrCat(service_, GetMethodInfo(Method::kModelStreamInfer).name),
             [this](Call* call, LoopServices* loop) {
               return Started(std::make_shared<InferStreamCall>(
                   &context_, call, handlers_.inference, &loop->deferred()));
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
