{{/* The pod, the same in a Deployment and in a StatefulSet. */}}
{{- define "spikeserve.pod" -}}
metadata:
  labels:
    {{- include "spikeserve.labels" . | nindent 4 }}
    {{- with .Values.pod.labels }}
    {{- toYaml . | nindent 4 }}
    {{- end }}
  {{- with .Values.pod.annotations }}
  annotations:
    {{- toYaml . | nindent 4 }}
  {{- end }}
spec:
  serviceAccountName: {{ include "spikeserve.name" . }}
  automountServiceAccountToken: false
  enableServiceLinks: false  # variables of services must not look like flags
  terminationGracePeriodSeconds: {{ include "spikeserve.graceSeconds" . }}
  securityContext:
    {{- include "spikeserve.podSecurityContext" . | nindent 4 }}
  {{- with include "spikeserve.placement" . | trim }}
  {{- . | nindent 2 }}
  {{- end }}
  {{- if and .Values.tls.secret (ne .Values.tls.probeName "localhost") }}
  hostAliases:  # the probe reaches this pod by a name of its certificate
    - {ip: 127.0.0.1, hostnames: [{{ .Values.tls.probeName | quote }}]}
  {{- end }}
  {{- with .Values.pod.affinity }}
  affinity:
    {{- toYaml . | nindent 4 }}
  {{- end }}
  topologySpreadConstraints:
    - maxSkew: 1
      topologyKey: kubernetes.io/hostname
      whenUnsatisfiable: ScheduleAnyway
      labelSelector:
        matchLabels:
          {{- include "spikeserve.selector" . | nindent 10 }}
  containers:
    - name: spikeserve
      image: {{ include "spikeserve.image" . | quote }}
      imagePullPolicy: {{ .Values.image.pullPolicy }}
      securityContext:
        {{- include "spikeserve.securityContext" . | nindent 8 }}
      env:
        {{- include "spikeserve.environment" . | nindent 8 }}
      ports:
        - {name: grpc, containerPort: 50051}
        - {name: http, containerPort: 9464}
        {{- with .Values.datagrams.hostPort }}
        - {name: datagrams, containerPort: 50052, hostPort: {{ int64 . }}, protocol: UDP}
        {{- end }}
      # Ready: has sessions to give. A server that an operator drains, or whose Redis is away at the start, is alive.
      readinessProbe:
        exec: {command: [/usr/bin/spikectl, health]}
        periodSeconds: 5
        timeoutSeconds: 5
        failureThreshold: 2
      startupProbe:
        {{- include "spikeserve.alive" . | nindent 8 }}
        periodSeconds: 1
        failureThreshold: 120  # a large store is checked at the start
      livenessProbe:
        {{- include "spikeserve.alive" . | nindent 8 }}
        periodSeconds: 10
        timeoutSeconds: 5
        failureThreshold: 6
      lifecycle:
        preStop:  # endpoints forget this pod before the server refuses calls
          sleep: {seconds: {{ .Values.drain.noticeSeconds }}}
      resources:
        {{- toYaml .Values.resources | nindent 8 }}
      {{- with include "spikeserve.mounts" . | trim }}
      volumeMounts:
        {{- . | nindent 8 }}
      {{- end }}
  {{- with include "spikeserve.volumes" . | trim }}
  volumes:
    {{- . | nindent 4 }}
  {{- end }}
{{- end -}}

{{/* Where a pod may run and who may pull its image. Without affinity, which may keep pods away from those of the server. */}}
{{- define "spikeserve.placement" -}}
{{- with .Values.image.pullSecrets }}
imagePullSecrets:
  {{- range . }}
  - {name: {{ . }}}
  {{- end }}
{{- end }}
{{- with .Values.pod.priorityClassName }}
priorityClassName: {{ . }}
{{- end }}
{{- with .Values.pod.nodeSelector }}
nodeSelector:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- with .Values.pod.tolerations }}
tolerations:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- end -}}

{{/* The kubelet's gRPC probe knows no TLS. */}}
{{- define "spikeserve.alive" -}}
{{- if .Values.tls.secret -}}
tcpSocket: {port: grpc}
{{- else -}}
grpc: {port: 50051, service: spikeserve.v1.PolicyAdmin}
{{- end -}}
{{- end -}}

{{- define "spikeserve.mounts" -}}
{{- if eq .Values.sessions.store "file" }}
- {name: state, mountPath: /var/lib/spikeserve}
{{- end }}
{{- if .Values.policies.claim }}
- {name: policies, mountPath: /policies, readOnly: {{ .Values.policies.readOnly }}}
{{- end }}
{{- range $name, $secret := include "spikeserve.secrets" . | fromYaml }}
- {name: {{ $name }}, mountPath: /etc/spikeserve/{{ $name }}, readOnly: true}
{{- end }}
{{- end -}}

{{- define "spikeserve.volumes" -}}
{{- if .Values.policies.claim }}
- {name: policies, persistentVolumeClaim: {claimName: {{ .Values.policies.claim }}, readOnly: {{ .Values.policies.readOnly }}}}
{{- end }}
{{- range $name, $secret := include "spikeserve.secrets" . | fromYaml }}
- {name: {{ $name }}, secret: {secretName: {{ $secret }}, defaultMode: 0440}}
{{- end }}
{{- end -}}

{{/* The secrets that are mounted, by the name of their folder. */}}
{{- define "spikeserve.secrets" -}}
{{- with .Values.tls.secret }}
tls: {{ . }}
{{- end }}
{{- with .Values.tokens.secret }}
tokens: {{ . }}
{{- end }}
{{- with .Values.signing.secret }}
signing: {{ . }}
{{- end }}
{{- if eq .Values.sessions.store "redis" }}
{{- with .Values.redis.passwordSecret }}
redis: {{ . }}
{{- end }}
{{- with .Values.redis.tlsSecret }}
redis-tls: {{ . }}
{{- end }}
{{- end }}
{{- end -}}
