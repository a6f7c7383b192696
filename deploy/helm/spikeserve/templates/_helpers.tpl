{{/* The name of all objects. Short enough for the names of the pods of a StatefulSet. */}}
{{- define "spikeserve.name" -}}
{{- if contains "spikeserve" .Release.Name -}}
{{- .Release.Name | trunc 40 | trimSuffix "-" -}}
{{- else -}}
{{- printf "%s-spikeserve" (.Release.Name | trunc 29 | trimSuffix "-") -}}
{{- end -}}
{{- end -}}

{{- define "spikeserve.selector" -}}
app.kubernetes.io/name: spikeserve
app.kubernetes.io/instance: {{ .Release.Name }}
{{- end -}}

{{- define "spikeserve.labels" -}}
{{ include "spikeserve.selector" . }}
app.kubernetes.io/version: {{ .Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .Release.Service }}
helm.sh/chart: {{ printf "%s-%s" .Chart.Name .Chart.Version | replace "+" "_" }}
{{- end -}}

{{- define "spikeserve.image" -}}
{{ .Values.image.repository }}:{{ .Values.image.tag | default .Chart.AppVersion }}
{{- end -}}

{{/* The kind of the workload: only a store on a volume needs an identity. */}}
{{- define "spikeserve.kind" -}}
{{ if eq .Values.sessions.store "file" }}StatefulSet{{ else }}Deployment{{ end }}
{{- end -}}

{{/* Everything of a pod that ends: the notice, the drain, and what the server needs to write and to leave. */}}
{{- define "spikeserve.graceSeconds" -}}
{{ add .Values.drain.noticeSeconds .Values.drain.timeoutSeconds 10 }}
{{- end -}}

{{- define "spikeserve.securityContext" -}}
allowPrivilegeEscalation: false
readOnlyRootFilesystem: true
capabilities: {drop: [ALL]}
{{- end -}}

{{- define "spikeserve.podSecurityContext" -}}
runAsNonRoot: true
{{- with .Values.pod.user }}
runAsUser: {{ int64 . }}
runAsGroup: {{ int64 . }}
fsGroup: {{ int64 . }}
{{- end }}
fsGroupChangePolicy: OnRootMismatch
seccompProfile: {type: RuntimeDefault}
{{- end -}}
