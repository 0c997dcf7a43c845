// The page of the questions at the end of a block: shows them, and sends the answers.

const VERSION = 2; // of the messages
const RETRY_MS = 1000;
const FIRST_FINAL = 4400; // the codes from here on: the same page is never let in

const byId = (id) => document.getElementById(id);
let socket = null;
let names = []; // of the scales; empty until the questions are shown
let isDone = false;

function connect() {
  socket = new WebSocket(`ws://${location.host}/socket`);
  socket.onopen = () => send({ type: "hello", version: VERSION, token: location.hash.slice(1) });
  socket.onmessage = ({ data }) => take(JSON.parse(data));
  socket.onclose = ({ code, reason }) => {
    if (isDone) return;
    byId("notice").textContent = reason || "not connected to lavt: the answers cannot be sent";
    if (code < FIRST_FINAL) setTimeout(connect, RETRY_MS);
  };
}

function send(message) {
  if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

function take(message) {
  byId("notice").textContent = message.notice;
  if (message.type === "questions" && names.length === 0) showQuestions(message);
  if (message.type === "thanks") {
    isDone = true;
    byId("form").hidden = true;
    socket.close();
  }
}

function showQuestions({ title, questions, step }) {
  byId("title").textContent = title;
  names = questions.map(([name]) => name);
  byId("scales").replaceChildren(...questions.map(([name, question]) => scale(name, question, step)));
  byId("form").hidden = false;
}

// A scale without a chosen point, so that no answer is suggested.
function scale(name, question, step) {
  const points = [];
  for (let value = 0; value <= 100; value += step) {
    const point = Object.assign(document.createElement("input"), { type: "radio", name, value, required: true });
    point.setAttribute("aria-label", value);
    points.push(point);
  }
  const row = document.createElement("div");
  row.append(text("span", "very low"), ...points, text("span", "very high"));
  const group = document.createElement("fieldset");
  group.append(text("legend", question), row);
  return group;
}

function text(tag, textContent) {
  return Object.assign(document.createElement(tag), { textContent });
}

byId("form").onsubmit = (event) => {
  event.preventDefault();
  const chosen = new FormData(byId("form"));
  const scales = Object.fromEntries(names.map((name) => [name, Number(chosen.get(name))]));
  send({ type: "answers", scales, comment: byId("comment").value });
};
connect();
