//! The cases. Each panics or returns an error if the server behaves otherwise.

use crate::health::health_client::HealthClient;
use crate::health::{HealthCheckRequest, health_check_response::ServingStatus};
use crate::v1::policy_admin_client::PolicyAdminClient;
use crate::v1::policy_service_client::PolicyServiceClient;
use crate::v1::{ActBatchRequest, ActRequest, ListPoliciesRequest, LoadPolicyRequest, OpenSessionRequest};
use std::time::Duration;
use tokio::sync::mpsc;
use tokio_stream::{StreamExt, wrappers::ReceiverStream};
use tonic::codec::CompressionEncoding;
use tonic::metadata::MetadataValue;
use tonic::transport::Channel;
use tonic::{Code, Request, Status};

type Outcome = Result<(), Box<dyn std::error::Error>>;
type Client = PolicyServiceClient<Channel>;

const MESSAGE_LIMIT: usize = 4194304;

pub async fn run(name: &str, channel: Channel) -> Outcome {
    let client = Client::new(channel.clone()).max_decoding_message_size(usize::MAX);
    match name {
        "empty_unary" => empty_unary(client).await,
        "large_unary" => large_unary(client).await,
        "ping_pong" => ping_pong(client).await,
        "half_close" => half_close(client).await,
        "empty_stream" => empty_stream(client).await,
        "cancel_after_begin" => cancel(client, 0).await,
        "cancel_after_first_response" => cancel(client, 1).await,
        "timeout" => timeout(client).await,
        "metadata" => metadata(client).await,
        "status_message" => status_message(channel).await,
        "unimplemented" => unimplemented(channel).await,
        "compression" => compression(client).await,
        "concurrent" => concurrent(client).await,
        "health" => health(channel).await,
        _ => Err(format!("case: expected a known name, received {name}").into()),
    }
}

fn act_request(session_id: &str, step: i64) -> ActRequest {
    let observation = vec![0.01, -0.02, 0.03, 0.1];
    ActRequest { session_id: session_id.into(), step, observation, ..Default::default() }
}

async fn open_session(client: &mut Client) -> Result<String, Status> {
    let request = OpenSessionRequest { policy: "cartpole".into(), ..Default::default() };
    Ok(client.open_session(request).await?.into_inner().session_id)
}

async fn empty_unary(mut client: Client) -> Outcome {
    let answer = client.list_policies(ListPoliciesRequest {}).await?.into_inner();
    assert!(!answer.policies.is_empty());
    Ok(())
}

async fn large_unary(mut client: Client) -> Outcome {
    let requests = vec![ActRequest { session_id: "x".repeat(3000), ..Default::default() }; 1000];
    let answer = client.act_batch(ActBatchRequest { requests }).await?.into_inner();
    assert_eq!(answer.results.len(), 1000);
    let long = ActRequest { session_id: "x".repeat(MESSAGE_LIMIT), ..Default::default() };
    let refused = client.act_batch(ActBatchRequest { requests: vec![long] }).await.unwrap_err();
    assert_eq!(refused.code(), Code::ResourceExhausted, "{refused}");
    Ok(())
}

async fn ping_pong(mut client: Client) -> Outcome {
    let session = open_session(&mut client).await?;
    let (sender, requests) = mpsc::channel(1);
    sender.send(act_request(&session, 0)).await?;
    let mut answers = client.act_stream(ReceiverStream::new(requests)).await?.into_inner();
    for step in 0..100 {
        let answer = answers.message().await?.expect("an answer");
        assert_eq!(answer.step, step);
        assert!(answer.error.is_none());
        sender.send(act_request(&session, step + 1)).await?;
    }
    drop(sender);
    assert_eq!(answers.message().await?.expect("an answer").step, 100);
    assert!(answers.message().await?.is_none());
    Ok(())
}

async fn half_close(mut client: Client) -> Outcome {
    let session = open_session(&mut client).await?;
    let requests: Vec<ActRequest> = (0..1000).map(|step| act_request(&session, step)).collect();
    let answers = client.act_stream(tokio_stream::iter(requests)).await?.into_inner();
    let answers: Vec<_> = answers.collect::<Result<_, _>>().await?;
    assert_eq!(answers.len(), 1000);
    Ok(())
}

async fn empty_stream(mut client: Client) -> Outcome {
    let mut answers = client.act_stream(tokio_stream::empty()).await?.into_inner();
    assert!(answers.message().await?.is_none());
    Ok(())
}

/// Drops a stream, which resets it, after `answered` answers.
async fn cancel(mut client: Client, answered: i64) -> Outcome {
    let session = open_session(&mut client).await?;
    let (sender, requests) = mpsc::channel(1);
    if answered == 0 {
        let call = client.act_stream(ReceiverStream::new(requests));
        assert!(tokio::time::timeout(Duration::from_millis(100), call).await.is_err());
    } else {
        sender.send(act_request(&session, 0)).await?;
        let mut answers = client.act_stream(ReceiverStream::new(requests)).await?.into_inner();
        assert!(answers.message().await?.is_some());
    }
    let answer = client.act(act_request(&session, answered)).await?.into_inner();
    assert_eq!(answer.step, answered);
    Ok(())
}

async fn timeout(mut client: Client) -> Outcome {
    let (_sender, requests) = mpsc::channel(1);
    let mut request = Request::new(ReceiverStream::new(requests));
    request.set_timeout(Duration::from_millis(200));
    let late = match client.act_stream(request).await {
        Ok(answers) => answers.into_inner().message().await.unwrap_err(),
        Err(status) => status,
    };
    // tonic's own timer ends the call with CANCELLED if it is first.
    assert!(matches!(late.code(), Code::DeadlineExceeded | Code::Cancelled), "{late}");
    Ok(())
}

async fn metadata(mut client: Client) -> Outcome {
    let mut request = Request::new(ListPoliciesRequest {});
    let bytes: Vec<u8> = (0..=255).collect();
    request.metadata_mut().append("x-text", "a, b".parse()?);
    request.metadata_mut().append("x-text", "c".parse()?);
    request.metadata_mut().append_bin("x-bytes-bin", MetadataValue::from_bytes(&bytes));
    request.metadata_mut().append_bin("x-bytes-bin", MetadataValue::from_bytes(&[0]));
    assert!(!client.list_policies(request).await?.into_inner().policies.is_empty());
    Ok(())
}

async fn status_message(channel: Channel) -> Outcome {
    let request = LoadPolicyRequest { policy: "cartpole".into(), version: 9, ..Default::default() };
    let refused = PolicyAdminClient::new(channel).load_policy(request).await.unwrap_err();
    assert_eq!(refused.code(), Code::NotFound);
    let expected = std::env::var("EXPECTED_MESSAGE")?;
    assert!(refused.message().starts_with(&expected), "{}", refused.message());
    Ok(())
}

async fn unimplemented(channel: Channel) -> Outcome {
    for path in ["/spikeserve.v1.PolicyService/NoSuchMethod", "/no.such.Service/Method"] {
        let mut client = tonic::client::Grpc::new(channel.clone());
        client.ready().await?;
        let codec = tonic_prost::ProstCodec::<ListPoliciesRequest, ListPoliciesRequest>::default();
        let request = Request::new(ListPoliciesRequest {});
        let refused = client.unary(request, path.parse()?, codec).await.unwrap_err();
        assert_eq!(refused.code(), Code::Unimplemented, "{refused}");
    }
    Ok(())
}

async fn compression(client: Client) -> Outcome {
    let mut client = client.send_compressed(CompressionEncoding::Gzip);
    let routing_key = "x".repeat(256);
    let request = OpenSessionRequest { policy: "cartpole".into(), routing_key, ..Default::default() };
    let answer = client.open_session(request).await?;
    assert!(!answer.into_inner().session_id.is_empty());
    Ok(())
}

async fn concurrent(client: Client) -> Outcome {
    let calls: Vec<_> = (0..1000)
        .map(|_| {
            let mut client = client.clone();
            tokio::spawn(async move { client.list_policies(ListPoliciesRequest {}).await })
        })
        .collect();
    for call in calls {
        assert!(!call.await??.into_inner().policies.is_empty());
    }
    Ok(())
}

async fn health(channel: Channel) -> Outcome {
    let mut client = HealthClient::new(channel);
    let checked = client.check(HealthCheckRequest::default()).await?.into_inner();
    assert_eq!(checked.status(), ServingStatus::Serving);
    let unknown = HealthCheckRequest { service: "no.such.Service".into() };
    assert_eq!(client.check(unknown).await.unwrap_err().code(), Code::NotFound);
    let mut watch = client.watch(HealthCheckRequest::default()).await?.into_inner();
    assert_eq!(watch.message().await?.expect("a status").status(), ServingStatus::Serving);
    Ok(())
}
