// The jobs of processes: their state, and running one to its end.

import { get, post, Refused } from "./api";
import type { Jobs, StatusInfo } from "./api_types";
import { when } from "./elements";
import { pause } from "./page";

const POLL_MS = 400;

/** The state of a job. */
export function find(id: string, signal: AbortSignal): Promise<StatusInfo> {
  return get<StatusInfo>(`jobs/${encodeURIComponent(id)}`, signal);
}

export function ended(job: StatusInfo): boolean {
  return !["accepted", "running"].includes(job.status);
}

/** The state of a job that has not ended, in words. */
export function stateText(job: StatusInfo): string {
  const { "amers:queuePosition": position, "amers:estimatedEnd": end } = job;
  const waiting = position == null ? "Waiting for a worker" : `Waiting for a worker: number ${position} in the queue`;
  const state = job.status === "accepted" ? waiting : `${job.progress} % · ${job.message ?? "running"}`;
  return end ? `${state} · expected to end on ${when(end)}` : state;
}

export interface Drawn {
  job: StatusInfo;
  results: Record<string, unknown>;
}

/** A job with some inputs and its results: an earlier one, or a new one, whose state `report` gets. */
export async function drawn(process: string, inputs: Record<string, unknown>, signal: AbortSignal, report: (job: StatusInfo) => void): Promise<Drawn> {
  const earlier = await drawnEarlier(process, inputs, signal);
  if (earlier) return earlier;
  const job = await run(process, inputs, signal, report);
  return { job, results: await resultsOf(job, signal) };
}

/** A job that ended with some inputs, and its results; null where there is none, or its results were removed. */
export async function drawnEarlier(process: string, inputs: Record<string, unknown>, signal: AbortSignal): Promise<Drawn | null> {
  const { jobs } = await get<Jobs>(`jobs?processID=${process}&status=successful&limit=100`, signal);
  const job = jobs.find((one) => Object.entries(inputs).every(([name, value]) => (one.inputs[name] ?? null) === value));
  if (!job) return null;
  try {
    return { job, results: await resultsOf(job, signal) };
  } catch (error) {
    if (error instanceof Refused) return null;
    throw error;
  }
}

function resultsOf({ jobID }: StatusInfo, signal: AbortSignal): Promise<Record<string, unknown>> {
  return get(`jobs/${jobID}/results`, signal);
}

/** Run a process to its end; an unsuccessful one is thrown in the words of the service. */
export async function run(process: string, inputs: object, signal: AbortSignal, report: (job: StatusInfo) => void): Promise<StatusInfo> {
  let job = await post<StatusInfo>(`processes/${process}/execution`, { inputs });
  while (!ended(job)) {
    report(job);
    await pause(POLL_MS, signal);
    job = await find(job.jobID, signal);
  }
  if (job.status !== "successful") throw new Error(job.error?.detail ?? `The job is ${job.status}.`);
  return job;
}
